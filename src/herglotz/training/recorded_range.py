"""Positions and momenta of a motion outside the range of the training data, where the model extrapolates."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.units import size, span

# Share of the width of the range. Predictions of training recordings leave their own range by up to 0.006 of its width.
MARGIN = 0.01
# Relative tolerance of a step, because recorded times are rounded.
ROUNDING = 1e-6
QUANTITIES = {"q": "position", "p": "momentum"}


@dataclass(frozen=True)
class Beyond:
    """One quantity, position or momentum, that leaves its recorded range from `low` to `high`.

    `by` is the largest distance from the range over its width (inf for width 0), `since` the time of the first sample
    outside. `unit` is that of a position, "" for a momentum; `degrees`: the file has degrees.
    """

    coordinate: str
    quantity: str
    by: float
    since: float
    low: float
    high: float
    unit: str
    degrees: bool = False
    trajectory: int = 0

    def words(self, time_unit: str) -> str:
        """One clause: the quantity, its range, the distance from the range, and the time."""
        ends, by = f"{size(self.high, self.unit, self.degrees)} throughout", ""
        if self.low < self.high:
            ends = span((self.low, self.high), self.unit, self.degrees)
            by = f" by {100 * self.by:.2g} % of its width"
        time = size(self.since, time_unit, digits=4)
        where = f" in trajectory {self.trajectory}" if self.trajectory else ""
        return f"the {self.quantity} of {self.coordinate} ({ends}){by}, since t = {time}{where}"


def near_recorded(states: Tensor, train: Trajectories) -> Tensor:
    """Those of the states (N, 2n+1) of a fit that lie in the recorded range of positions; all if none do.

    Where a model does not follow its data, its states go where nothing was recorded.
    """
    seen = (torch.ones_like(train.q) if train.observed is None else train.observed).bool()
    low, high = train.q.where(seen, torch.inf).amin(0), train.q.where(seen, -torch.inf).amax(0)
    q, edge = states[:, : train.dof], MARGIN * (high - low)
    inside = ((q >= low - edge) & (q <= high + edge)).all(-1)
    return states[inside] if bool(inside.any()) else states


def box_of(q: Tensor, p: Tensor, s: Tensor) -> dict[str, list[float]]:
    """Lowest and highest q, p and s over a set of states."""
    ends = {name: x.aminmax(dim=0) for name, x in (("q", q), ("p", p), ("s", s[:, None]))}
    return {f"{name}_{end}": x.tolist() for name, (a, b) in ends.items() for end, x in (("low", a), ("high", b))}


def quantities_outside(
    box: Mapping[str, Sequence[float]],
    like: Trajectories,
    t: Tensor,  # (N,)
    q: Tensor,  # (..., N, n)
    p: Tensor,  # (..., N, n)
) -> list[Beyond]:
    """Every position and momentum that leaves its range by more than `MARGIN`, for the motion that leaves it farthest.

    `box` holds the lowest and highest q and p of the fit; an empty box has no range. `like` has the names, units and
    angles of the coordinates. q and p are motions at the same times t, NaN after a failed step. Angles are compared
    modulo 2π.
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
    """For each quantity the trajectory that leaves its range farthest; `motions` are trajectories with own times."""
    every = [replace(each, trajectory=b) for b, found in enumerate(motions) for each in found]
    first: dict[tuple[str, str], Beyond] = {}
    for each in sorted(every, key=lambda each: -each.by):
        first.setdefault((each.coordinate, each.quantity), each)
    return tuple(first.values())


def warning(found: Sequence[Beyond], time_unit: str) -> str:
    """One sentence; "" if no quantity leaves its range."""
    if not found:
        return ""
    each = "; ".join(one.words(time_unit) for one in found)
    return f"the motion leaves the range that the model was fitted to, beyond which it extrapolates: {each}"


def other_steps(times: Tensor, h_range: tuple[float, float], time_unit: str) -> str:
    """One sentence if steps are shorter or longer than those of the fit, else ""."""
    (low, high), steps = h_range, times.diff()
    if low * (1 - ROUNDING) <= float(steps.min()) and float(steps.max()) <= high * (1 + ROUNDING):
        return ""
    mean = f"steps of {size(float(steps.mean()), time_unit, digits=6)}"
    return f"{mean} are outside of those that the model was fitted to, {span(h_range, time_unit)}"


def range_in_words(box: Mapping[str, Sequence[float]], like: Trajectories) -> str:
    """The range of the training data in words; "" if unknown."""
    if not box:
        return ""
    parts = []
    for i, (name, unit) in enumerate(zip(like.names, like.units, strict=True)):
        q, p = ((box[f"{key}_low"][i], box[f"{key}_high"][i]) for key in "qp")
        parts.append(f"{name} {span(q, unit, name in like.degrees)}, its momentum {span(p)}")
    return "; ".join(parts)
