"""`herglotz select`: find the level of the ladder that these data need."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from herglotz.cli.common import count, exit_code, print_json, print_next_of
from herglotz.cli.flags import add_progress_flags, add_run_flags, check_run_folder, columns_of, progress
from herglotz.cli.settings import LEVELS, add_machine_flags, data_of, settings_of

DESCRIPTION = """\
Fit every level of the ladder from several seeds on the first part of each trajectory, compare free runs over the rest,
and keep the level of fewest parameters that is not beaten beyond its spread. RUN receives the chosen run (as from
`herglotz fit`), selection.json and selection.png. The last line is the verdict on the chosen run; the exit code is 3
where it does not fit.

examples:
  herglotz select pendulum.csv --out runs/selected
  herglotz select pendulum.csv --out runs/selected --levels linear,affine --seeds 5
"""


def add(commands: argparse._SubParsersAction) -> None:
    """Add the subcommand."""
    parser = commands.add_parser("select", help="compare kinds of damping, keep the simplest", description=DESCRIPTION)
    add_run_flags(parser)
    parser.add_argument(
        "--levels",
        help=f"levels to compare, with commas, of {', '.join(LEVELS)}, auto (what fit does by itself); default: all "
        "but full, and auto where nothing is said of the terms; with recorded inputs u: forced and auto",
    )
    parser.add_argument("--seeds", type=count, default=3, help="fits a level (default %(default)s)")
    add_progress_flags(parser)
    add_machine_flags(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Read, check the output, fit the ladder, save the chosen run, report."""
    out: Path = arguments.out
    check_run_folder(out, arguments.resume)

    from herglotz.data.files import write_atomically
    from herglotz.data.lock import locked
    from herglotz.plots import plot_selection, save_figure
    from herglotz.training import save_run, select
    from herglotz.training.selection import check_levels

    levels = None
    if arguments.levels is not None:
        levels = [name.strip() for name in arguments.levels.split(",") if name.strip()]
    check_levels(levels)
    data, reading = data_of(arguments, columns_of(arguments))
    config = settings_of(arguments)
    with locked(out):
        found = select(
            data, levels, arguments.seeds, config, out=out, resume=arguments.resume, progress=progress(arguments)
        )
        save_run(replace(found.run, reading=reading), out)
        write_atomically(out / "selection.json", found.to_json().encode())
        save_figure(plot_selection(found), out / "selection.png")
    if arguments.json:
        print_json(json.loads(found.to_json()))
    else:
        print(found.table())
        print("The chosen run:")
        print(found.run.summary())
        print(f"Figure: {out / 'selection.png'}")
        print_next_of(found.run, out, ["verify", out])
    return exit_code(found.run)
