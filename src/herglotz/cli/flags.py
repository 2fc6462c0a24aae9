"""Flags that several commands share, and functions that read them."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, Literal

from herglotz.cli.common import check_output_folder, existing, finite, flag
from herglotz.cli.settings import DATA
from herglotz.errors import InputError

# Values of `progress` of `herglotz.training.fit`.
Progress = Literal[False, "lines", "iterations"] | None


def names(text: str) -> list[str]:
    """Return [] for `none`, and [a, b] for `a,b` (argparse type)."""
    return [] if text.strip().lower() == "none" else [name.strip() for name in text.split(",") if name.strip()]


# How a file is read: roles of columns, angles, and zeros and scales of sensors.
EACH = "a number for each coordinate, or for each of every recording: positions are scale * (reading - zero)"
READING = (
    "how DATA is read (default: by the names of its columns, printed as a table)",
    flag("--time", "column of the time", metavar="NAME"),
    flag("--coordinates", "exactly these, with commas", type=names, metavar="NAMES"),
    flag("--inputs", "forces, torques, ...: exactly these, or none", type=names, metavar="NAMES"),
    flag("--drop", "columns to leave aside", type=names, metavar="NAMES"),
    flag("--group", "column that numbers the trajectories", metavar="NAME"),
    flag("--angles", "coordinates that are angles in radians, with commas, or none (default: those with the unit rad "
         "or deg)", type=names, metavar="NAMES"),
    flag("--degrees", "coordinates in degrees whose header does not say so, or none (default: with a warning, those "
         "without a unit whose name is that of an angle and whose motion cannot be one in rad)",
         type=names, metavar="NAMES"),
    flag("--polar", "positions of a body on a circle that become one angle: x,y (centre and radius by least squares), "
         "x,y,X,Y with the centre in numbers or columns, x,y,X,Y,r keeps the distance r; x,-y where y grows "
         "downwards; again for the next body of a chain; none to leave positions as they are",
         action="append", metavar="X,Y"),
    flag("--input-terms", "terms of inputs that act beside them, with commas: V^2, |V|, V', sat(V/2) or tanh(V/2) "
         "of an input V, 2 being the level at which it saturates (default: those that the data ask for)",
         type=names, metavar="TERMS"),
    flag("--sensor-zeros", f"what the sensors read where the coordinates are 0, {EACH}",
         type=finite, nargs="+", metavar="X"),
    flag("--sensor-scales", f"what one unit of each reading is worth, {EACH}", type=finite, nargs="+", metavar="X"),
)  # fmt: skip
PROGRESS = (
    flag("--quiet", "no progress: neither a bar nor lines", action="store_true"),
    flag("--verbose", "a line for every iteration, with its cost", action="store_true"),
)
FORCE = flag("--force", "overwrite the file that --out names", action="store_true")
TRUST = flag("--trust-code", "open a .pt2 or .h file that was not written by this user on this machine: that runs the "
             "code in it", action="store_true")  # fmt: skip
# Flags of the commands that fit.
RUN = (
    flag("data", "file with time and positions, or a folder of them", metavar="DATA", type=existing),
    flag("--out", "folder for the result; made if missing", required=True, type=Path, metavar="RUN"),
    flag("--resume", "go on after an interruption, with the same flags", action="store_true"),
    *DATA,
)


def columns_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `load` that the flags of `READING` give."""
    names = (
        "angles", "degrees", "polar", "input_terms", "sensor_zeros", "sensor_scales", "time", "coordinates", "inputs",
        "drop", "group",
    )  # fmt: skip
    return {name: value for name in names if (value := getattr(arguments, name)) is not None}


def progress(arguments: argparse.Namespace) -> Progress:
    """None for a bar (at a terminal), "lines" for a line a stage, "iterations" for --verbose, False for --quiet."""
    if arguments.quiet:
        return False
    return "iterations" if arguments.verbose else None if sys.stderr.isatty() else "lines"


def check_run_folder(out: Path, resume: bool) -> None:
    """Raise InputError unless a run can be written to this folder without losing an earlier fit."""
    check_output_folder(out)
    if (out / "model.pt").exists() and not resume:
        raise InputError(f"--out {out}: already holds a run; choose another folder, delete it, or add --resume")
    if (out / "checkpoint.pt").exists() and not resume:
        raise InputError(f"--out {out}: holds a fit that was interrupted; add --resume to go on, or delete the folder")
