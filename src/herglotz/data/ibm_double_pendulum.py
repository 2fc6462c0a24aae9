"""The tracked markers of a real chaotic double pendulum (Asseman, Kornuta & Ozcan 2018)."""

from __future__ import annotations

from pathlib import Path

import torch

from herglotz.data.files import PathLike, read_lines
from herglotz.data.rows import number
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError

# Pivot, elbow, tip. The first number of a pair grows downwards: in every run the upper arm comes to rest along +x.
MARKERS = ("x_red", "y_red", "x_green", "y_green", "x_blue", "y_blue")
RATE = 400.0  # frames per second


def read_ibm_double_pendulum(path: PathLike) -> Trajectories:
    """Read one run: rows of six integers without a header, one row a video frame.

    Returns
    -------
    Trajectories
        The absolute angles `theta1` (pivot to elbow) and `theta2` (elbow to tip), rad, 0 when hanging down (along +x),
        positive towards +y, continuous from frame to frame; time in s.

    Raises
    ------
    InputError
        Naming file, row (line of the file, from 1), column, value and remedy.
    """
    path, rows = Path(path), []
    for i, line in enumerate(read_lines(path), 1):
        if not line.strip():
            continue
        cells = line.split(",")
        if len(cells) != len(MARKERS):
            raise InputError(
                f"{path}, row {i}: {len(cells)} numbers where {len(MARKERS)} belong ({', '.join(MARKERS)}); "
                "correct or delete the row"
            )
        labelled = zip(MARKERS, cells, strict=True)
        rows.append([number(cell.strip(), f"{path}, row {i}, column '{name}'") for name, cell in labelled])
    if not rows:
        raise InputError(f"{path}: holds no row; give a file of tracked markers")
    x = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3, 2)
    arms = x.diff(dim=1)  # (N, 2, 2) pivot → elbow, elbow → tip
    flat = (arms == 0).all(-1).any(-1)
    if bool(flat.any()):
        at = int(flat.nonzero()[0]) + 1
        raise InputError(f"{path}, row {at}: two markers lie on one point, so an arm has no angle; delete the row")
    return Trajectories.of(
        torch.arange(len(rows), dtype=torch.float64) / RATE,
        torch.atan2(arms[..., 1], arms[..., 0]),
        names=("theta1", "theta2"),
        angles=(True, True),
        time_unit="s",
        source=path.name,
    ).unwrapped()


def looks_like_markers(start: str) -> bool:
    """Whether a csv file begins with a row of six numbers instead of a header."""
    cells = start.strip().split(",")
    return len(cells) == len(MARKERS) and all(cell.strip().lstrip("-").isdigit() for cell in cells)
