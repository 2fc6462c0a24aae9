"""Where a motion leaves the range of positions and momenta that a fit was trained on: there the model extrapolates."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.units import size, span

MARGIN = 0.01  # of the width: recordings of fits predicted again leave their own range by up to 0.006 of it
HAIR = 1e-6  # of a step: recorded times are rounded
QUANTITIES = {"q": "position", "p": "momentum"}  # the first coordinate's mass is 1: its momentum is its velocity


@dataclass(frozen=True)
class Beyond:
    """One quantity that leaves its recorded range."""

    coordinate: str
    quantity: str  # "position" or "momentum"
    by: float  # largest distance from the range, over its width; infinite where that is 0
    since: float  # time of the first sample outside
    low: float  # the recorded range
    high: float
    unit: str  # of a position; "" of a momentum
    degrees: bool = False  # whether it was recorded in degrees
    trajectory: int = 0

    def words(self, time_unit: str) -> str:
        """One clause for people: what leaves which range, how far, and since when."""
        moved = self.low < self.high
        ends = (
            span((self.low, self.high), self.unit, self.degrees)
            if moved
            else f"{size(self.high, self.unit, self.degrees)} throughout"
        )
        time = size(self.since, time_unit, digits=4)
        where = f" in trajectory {self.trajectory}" if self.trajectory else ""
        by = f" by {100 * self.by:.2g} % of its width" if moved else ""
        return f"the {self.quantity} of {self.coordinate} ({ends}){by}, since t = {time}{where}"


def box_of(q: Tensor, p: Tensor, s: Tensor) -> dict[str, list[float]]:
    """Lowest and highest q, p and s over a set of states."""
    columns = {"q": q, "p": p, "s": s[:, None]}
    return {
        f"{name}_{end}": (x.amin(0) if end == "low" else x.amax(0)).tolist()
        for name, x in columns.items()
        for end in ("low", "high")
    }


def quantities_outside(
    box: Mapping[str, Sequence[float]],  # lowest and highest q and p of the fit; nothing is beyond an empty one
    like: Trajectories,  # names, units and angles of the coordinates
    t: Tensor,  # (N,)
    q: Tensor,  # (..., N, n) motions at the same times; NaN after a failed step
    p: Tensor,  # (..., N, n)
) -> list[Beyond]:
    """Every position and momentum that leaves its range by more than `MARGIN`, of the motion that leaves it farthest.

    Angles are taken modulo 2π.
    """
    found = []
    for key, x in (("q", q), ("p", p)) if box else ():
        for i, name in enumerate(like.names):
            low, high = box[f"{key}_low"][i], box[f"{key}_high"][i]
            y = x[..., i].double().reshape(-1, len(t))
            if key == "q" and like.angles[i]:
                y = y - 2 * math.pi * torch.round((y - (low + high) / 2) / (2 * math.pi))
            every = torch.maximum(low - y, y - high).nan_to_num(nan=0.0)
            outside = every > MARGIN * (high - low)
            if bool(outside.any()):
                b = int(every.amax(1).argmax())
                by = float(every[b].max()) / (high - low) if high > low else math.inf
                since, unit = float(t[outside[b].nonzero()[0, 0]]), like.units[i] if key == "q" else ""
                turned = key == "q" and name in like.degrees
                found.append(Beyond(name, QUANTITIES[key], by, since, low, high, unit, turned, b))
    return found


def farthest(motions: Iterable[Sequence[Beyond]]) -> tuple[Beyond, ...]:
    """Of trajectories with times of their own, for each quantity the one that leaves its range farthest."""
    every = [replace(each, trajectory=b) for b, found in enumerate(motions) for each in found]
    first: dict[tuple[str, str], Beyond] = {}
    for each in sorted(every, key=lambda each: -each.by):
        first.setdefault((each.coordinate, each.quantity), each)
    return tuple(first.values())


def warning(found: Sequence[Beyond], time_unit: str) -> str:
    """One sentence; "" where nothing leaves its range."""
    if not found:
        return ""
    each = "; ".join(one.words(time_unit) for one in found)
    return f"the motion leaves the range that the model was fitted to, beyond which it extrapolates: {each}"


def other_steps(times: Tensor, h_range: tuple[float, float], time_unit: str) -> str:
    """One sentence where steps are shorter or longer than those of the fit; "" where none is."""
    (low, high), steps = h_range, times.diff()
    if low * (1 - HAIR) <= float(steps.min()) and float(steps.max()) <= high * (1 + HAIR):
        return ""
    mean = f"steps of {size(float(steps.mean()), time_unit, digits=6)}"
    return f"{mean} are outside of those that the model was fitted to, {span(h_range, time_unit)}"


def range_in_words(box: Mapping[str, Sequence[float]], like: Trajectories) -> str:
    """The range that a fit was trained on, in words; "" where it is not known."""
    if not box:
        return ""
    parts = []
    for i, (name, unit) in enumerate(zip(like.names, like.units, strict=True)):
        q, p = ((box[f"{key}_low"][i], box[f"{key}_high"][i]) for key in "qp")
        parts.append(f"{name} {span(q, unit, name in like.degrees)}, its momentum {span(p)}")
    return "; ".join(parts)
