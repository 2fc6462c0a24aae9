"""`herglotz select`: find the level of the ladder that these data need."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from herglotz.cli.common import check_output_folder, count, finite, print_json
from herglotz.cli.fit import LEVELS, parse_angles
from herglotz.errors import InputError

DESCRIPTION = """\
Fit every level of the ladder from several seeds on the first part of each trajectory, compare free runs over the rest,
and keep the simplest level that is not beaten beyond its spread. RUN receives the chosen run (as from `herglotz fit`),
selection.json and selection.png.

examples:
  herglotz select pendulum.csv --out runs/selected
  herglotz select pendulum.csv --out runs/selected --levels linear,affine --seeds 5
"""


def add(commands: argparse._SubParsersAction) -> None:
    """Add the subcommand."""
    parser = commands.add_parser("select", help="fit the ladder, keep the simplest level", description=DESCRIPTION)
    parser.add_argument("data", metavar="DATA", type=Path, help="file with time and positions")
    parser.add_argument("--out", required=True, type=Path, metavar="RUN", help="folder for the result; made if missing")
    parser.add_argument(
        "--levels",
        help=f"levels to compare, with commas, of {', '.join(LEVELS)}, auto (what fit does by itself); default: all "
        "but full, and auto for joints; with recorded inputs u: forced",
    )
    parser.add_argument("--seeds", type=count, default=3, help="fits a level (default %(default)s)")
    parser.add_argument("--seed", type=count, default=0, help="the first of them (default %(default)s)")
    parser.add_argument(
        "--train-fraction", type=finite, default=0.667, metavar="F",
        help="part of every trajectory, in time, to train on, 0 < F < 1 (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--angles", metavar="NAMES",
        help="coordinates that are angles in radians, with commas, or none (default: those with the unit rad)",
    )  # fmt: skip
    parser.add_argument("--resume", action="store_true", help="go on after an interruption")
    parser.add_argument("--json", action="store_true", help="print the table as JSON, and nothing else")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Read, check the output, fit the ladder, save the chosen run, report."""
    out: Path = arguments.out
    check_output_folder(out)
    if (out / "model.pt").exists() and not arguments.resume:
        raise InputError(f"--out {out}: already holds a run; choose another folder, delete it, or add --resume")

    from herglotz.data import load
    from herglotz.data.files import write_atomically
    from herglotz.plots import plot_selection, save_figure
    from herglotz.training import FitConfig, save_run, select

    data = load(arguments.data, angles=parse_angles(arguments.angles))
    config = FitConfig(train_fraction=arguments.train_fraction, seed=arguments.seed)
    levels = None
    if arguments.levels is not None:
        levels = [name.strip() for name in arguments.levels.split(",") if name.strip()]
    found = select(data, levels, arguments.seeds, config, out=out, resume=arguments.resume)
    save_run(found.run, out)
    write_atomically(out / "selection.json", found.to_json().encode())
    save_figure(plot_selection(found), out / "selection.png")
    if arguments.json:
        print_json(json.loads(found.to_json()))
    else:
        print(found.table())
        print(f"Figure: {out / 'selection.png'}")
        print(f"Next: herglotz verify {out}")
    return 0
