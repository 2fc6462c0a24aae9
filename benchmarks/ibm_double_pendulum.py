"""The tracked markers of a real chaotic double pendulum (Asseman, Kornuta & Ozcan 2018)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from herglotz.data import Trajectories

RATE = 400.0  # frames per second


def read_ibm_double_pendulum(path: Path) -> Trajectories:
    """One run: rows of six integers without a header, one row a video frame, (x, y) of pivot, elbow and tip.

    The angles `theta1` (pivot to elbow) and `theta2` (elbow to tip) are absolute, in rad, 0 when hanging down,
    continuous from frame to frame. x grows downwards: in every run the upper arm comes to rest along +x.
    """
    markers = torch.from_numpy(np.loadtxt(path, delimiter=",", ndmin=2)).reshape(-1, 3, 2)
    x, y = markers.diff(dim=1).unbind(-1)
    t = torch.arange(len(markers), dtype=torch.float64) / RATE
    names = ("theta1", "theta2")
    return Trajectories.of(t, torch.atan2(y, x), names=names, angles=(True, True), source=path.name).unwrapped()
