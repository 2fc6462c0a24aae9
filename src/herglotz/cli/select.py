"""`herglotz select`: find the level of the ladder that these data need."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from herglotz.choices import LEVELS
from herglotz.cli.common import count, exit_code, flag, import_torch, print_json, print_next_of
from herglotz.cli.fit import USAGE as USAGE
from herglotz.cli.flags import (
    MACHINE,
    PROGRESS,
    READING,
    RUN,
    check_run_folder,
    columns_of,
    data_of,
    progress,
    settings_of,
)

DESCRIPTION = """\
Fit every level of the ladder on the first part of each trajectory, from several seeds unless it is beaten at the first,
compare free runs over the rest, and keep the level of fewest parameters that is not beaten beyond its spread. RUN
receives the chosen run (as from `herglotz fit`), selection.json and selection.png. The last line is the verdict on the
chosen run; the exit code is 3 where it does not fit.

examples:
  herglotz select pendulum.csv --out runs/selected
  herglotz select pendulum.csv --out runs/selected --levels linear,affine --seeds 5
"""


HELP = "compare kinds of damping, keep the simplest"
FLAGS = (
    *RUN,
    flag("--levels", f"levels to compare, with commas, of {', '.join(LEVELS)}, auto (what fit does by itself); "
         "default: all but full, and auto where nothing is said of the terms; with recorded inputs u: forced and auto"),
    flag("--seeds", "fits a level that is not beaten at the first seed (default %(default)s)", type=count, default=3),
    *PROGRESS,
    *MACHINE,
    *READING,
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Read, check the output, fit the ladder, save the chosen run, report."""
    out: Path = arguments.out
    check_run_folder(out, arguments.resume)
    import_torch()

    from herglotz.data.files import locked, write_atomically
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
