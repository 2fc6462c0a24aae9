"""The text files that accompany Schmidt & Lipson, "Distilling free-form natural laws", Science 324:81 (2009)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from herglotz.data import Trajectories

# Name and unit of the coordinate that the first line of a file names.
COORDINATES = {"o": ("theta", "rad"), "x": ("x", "pixel")}


def read_schmidt_lipson(path: Path) -> Trajectories:
    """One trajectory: a first line `% o v` or `% x v`, then rows of trial, time, coordinate and velocity.

    The files give no unit of time. Velocities are not read: in `real_pend_h_1` the column is 0.954 times dq/dt.
    """
    with path.open(encoding="ascii") as file:
        name, unit = COORDINATES[file.readline().strip("% ")[0]]
    _, t, q, _ = np.loadtxt(path, comments="%", unpack=True)
    angle = unit == "rad"
    return Trajectories.of(
        t, q, names=[name], units=[unit], angles=[angle], time_unit="1", source=path.name
    ).unwrapped()
