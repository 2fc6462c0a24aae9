"""Flags that several commands share, and their checks."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, Literal

from herglotz.cli.common import check_output_folder, existing, finite
from herglotz.cli.settings import add_data_settings
from herglotz.errors import InputError

Progress = Literal[False, "lines", "iterations"] | None  # what `herglotz.training.fit` takes


def add_run_flags(parser: argparse.ArgumentParser) -> None:
    """Add DATA, --out and --resume, --config, and how the data are read: --angles, --train-fraction."""
    parser.usage = "%(prog)s DATA --out RUN [flag ...]"  # all of the flags are twenty lines
    parser.add_argument("data", metavar="DATA", type=existing, help="file with time and positions, or a folder of them")
    parser.add_argument("--out", required=True, type=Path, metavar="RUN", help="folder for the result; made if missing")
    parser.add_argument("--resume", action="store_true", help="go on after an interruption, with the same flags")
    add_data_settings(parser)
    add_column_flags(parser)


def add_column_flags(parser: argparse.ArgumentParser) -> None:
    """Add what says how a file is read: --angles, what its sensors read, and the roles of a csv file's columns."""
    parser.add_argument(
        "--angles", type=names, metavar="NAMES",
        help="coordinates that are angles in radians, with commas, or none (default: those with the unit rad or deg)",
    )  # fmt: skip
    for flag, what in (
        ("--sensor-zeros", "what the sensors read where the coordinates are 0"),
        ("--sensor-scales", "what one unit of each reading is worth"),
    ):
        parser.add_argument(
            flag, type=finite, nargs="+", metavar="X",
            help=f"{what}, a number for each coordinate, or for each of every recording: positions are "
            "scale * (reading - zero)",
        )  # fmt: skip
    columns = parser.add_argument_group("columns of a csv file (default: by their names, printed as a table)")
    columns.add_argument("--time", metavar="NAME", help="column of the time")
    columns.add_argument("--coordinates", type=names, metavar="NAMES", help="exactly these, with commas")
    columns.add_argument("--inputs", type=names, metavar="NAMES", help="forces, torques, ...: exactly these, or none")
    columns.add_argument("--drop", type=names, metavar="NAMES", help="columns to leave aside")
    columns.add_argument("--group", metavar="NAME", help="column that numbers the trajectories")


def columns_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what the flags say of the columns, for `load`."""
    roles = ("angles", "time", "coordinates", "inputs", "drop", "group", "sensor_zeros", "sensor_scales")
    given = {name: getattr(arguments, name) for name in roles}
    return {name: value for name, value in given.items() if value is not None}


def add_progress_flags(parser: argparse.ArgumentParser) -> None:
    """Add --quiet and --verbose."""
    parser.add_argument("--quiet", action="store_true", help="no progress: neither a bar nor lines")
    parser.add_argument("--verbose", action="store_true", help="a line for every iteration, with its cost")


def progress(arguments: argparse.Namespace) -> Progress:
    """A bar on a terminal, a line a stage elsewhere, a line an iteration when verbose, nothing when quiet."""
    if arguments.quiet:
        return False
    return "iterations" if arguments.verbose else None if sys.stderr.isatty() else "lines"


def add_force_flag(parser: argparse.ArgumentParser) -> None:
    """Add --force."""
    parser.add_argument("--force", action="store_true", help="overwrite the file that --out names")


def add_trust_flag(parser: argparse.ArgumentParser) -> None:
    """Add --trust-code."""
    parser.add_argument(
        "--trust-code", action="store_true",
        help="open a .pt2 or .h file that was not written by this user on this machine: that runs the code in it",
    )  # fmt: skip


def check_run_folder(out: Path, resume: bool) -> None:
    """Raise unless a run can be written there: nothing in the way, and no fit that would be lost."""
    check_output_folder(out)
    if (out / "model.pt").exists() and not resume:
        raise InputError(f"--out {out}: already holds a run; choose another folder, delete it, or add --resume")
    if (out / "checkpoint.pt").exists() and not resume:
        raise InputError(f"--out {out}: holds a fit that was interrupted; add --resume to go on, or delete the folder")


def names(text: str) -> list[str]:
    """Return [] for `none`, and [a, b] for `a,b` (argparse type)."""
    return [] if text.strip().lower() == "none" else [name.strip() for name in text.split(",") if name.strip()]
