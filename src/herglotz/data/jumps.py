"""Coordinates that move in jumps alone: set points, which a table may hold under the name of a coordinate."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data.csv_columns import Wanted
from herglotz.data.gaps import complete
from herglotz.data.trajectories import GAP, Trajectories
from herglotz.data.units import in_degrees
from herglotz.errors import InputError

# Levels that the message names.
MAX_LEVELS = 4


def jumping(data: Trajectories) -> list[str]:
    """Names of the coordinates that stand still except for jumps.

    A mechanism that never moves in two steps in a row is slow, and goes from one level of its sensor to the next level.
    A set point leaps over a level that was recorded at another time, or has two levels in all. Steps over gaps do not
    count.
    """
    steps = data.steps()
    close = steps.h <= GAP * steps.h.median()
    rows = zip(data.names, data.q.T, strict=True)
    return [name for name, q in rows if _jumps(q, steps.index, close, steps.trajectory.diff() == 0)]


def _jumps(
    q: Tensor,  # (N,) one coordinate
    row: Tensor,  # (K,) sample at which each step starts
    close: Tensor,  # (K,) bool: no gap
    pair: Tensor,  # (K - 1,) bool: a step and the next step belong to one trajectory
) -> bool:
    """Whether a coordinate never moves in two steps in a row, and moves at least once between two steps at rest."""
    same = q[row + 1] == q[row]
    moves, still = close & ~same, close & same
    between = moves[1:-1] & still[:-2] & still[2:] & pair[:-1] & pair[1:]
    if bool((moves[:-1] & moves[1:] & pair).any()) or not bool(between.any()):
        return False
    levels, level = torch.unique(q, return_inverse=True)
    leaps = (level[row + 1] - level[row])[moves].abs() > 1
    return len(levels) == 2 or bool(leaps.any())


def refuse_jumps(data: Trajectories, wanted: Wanted) -> None:
    """Raise if a coordinate that the user has not named moves in jumps alone, because no model fits such a motion."""
    if wanted.coordinates is not None or not wanted.motion:
        return
    found = [name for name in jumping(complete(data)) if wanted.before(name) is None]
    if not found:
        return
    inputs = ",".join([*(name for name, _ in data.input_labels), *found])
    what = f"{', '.join(found)} {'moves' if len(found) == 1 else 'move'} in jumps alone ({_levels(data, found[0])})"
    raise InputError(
        f"{data.source or 'data'}: {what}; an input? --inputs {inputs} (inputs= in Python); a coordinate all the same: "
        f"--coordinates {','.join(data.names)}"
    )


def _levels(data: Trajectories, name: str) -> str:
    """The first levels of a coordinate, in the unit of its column."""
    q = in_degrees(data, data.degrees).q[:, data.names.index(name)]
    seen = list(dict.fromkeys(f"{x:.4g}" for x in q.tolist()))
    return ", ".join(seen if len(seen) <= MAX_LEVELS else [*seen[:MAX_LEVELS], "…"])
