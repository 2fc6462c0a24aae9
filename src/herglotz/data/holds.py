"""Values between samples: inputs by their hold, and missing positions from readings of the same coordinate.

The hold of an input says how the recorded u_k become the input of a step, or of a part of it:

    zero     u_k from sample k to the next: a controller's output
    first    straight lines between the samples: the mean over a step is (u_k + u_{k+1})/2
    smooth   polynomials through eight samples: a signal without steps, sampled at the same times as the motion

A model takes one input a step. Where u changes within the step the rule of order 2 needs the value in the middle: a
hold gives the value, for the whole recorded step or for each of the equal parts in which the step is crossed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.choices import HOLDS
from herglotz.errors import InputError

# Samples through which each hold draws its polynomial.
SAMPLES: dict[str, int] = dict(zip(HOLDS, (1, 2, 8), strict=True))


class Arrival(NamedTuple):
    """Hold, delay and time constant of the actuator, in units of time, of recorded inputs; "" or None: unspecified."""

    hold: str = ""
    delay: float | None = None
    lag: float | None = None

    @property
    def late(self) -> tuple[float, float]:
        """Delay and lag; 0 where unspecified."""
        return self.delay or 0.0, self.lag or 0.0


UNSPECIFIED = Arrival()


def check_arrival(where: str, arrival: Arrival) -> None:
    """Raise unless the hold is one of `HOLDS` or unspecified, and delay and lag are times >= 0."""
    if arrival.hold not in ("", *HOLDS):
        raise InputError(f"{where}: unknown hold {arrival.hold!r} of the inputs; choose one of {', '.join(HOLDS)}")
    for name, value in zip(("delay", "lag"), arrival.late, strict=True):
        if not 0 <= value < float("inf"):
            raise InputError(f"{where}: the {name} of the inputs must be a time >= 0, got {value:g}")


def interpolated_input(
    hold: str,
    t: Tensor,  # (N,) time
    u: Tensor,  # (N, m)
    lengths: Sequence[int],
    row: Tensor,  # (...) sample at which each recorded step starts
    part: Tensor,  # (...) where in the step, from 0 to 1
) -> Tensor:
    """The input in these steps, (..., m): polynomials through the nearest samples of the same trajectory.

    `lengths` are the samples of each trajectory; a hold that is not specified ("") is "zero".
    """
    if hold in ("", "zero"):
        return u[row]
    counts = torch.tensor(lengths, device=u.device)
    ends = counts.cumsum(0)
    own = torch.bucketize(row, ends, right=True)
    first, last = (ends - counts)[own], ends[own] - 1
    after = torch.minimum(row + 1, last)
    time = t[row] + part * (t[after] - t[row])
    count = min(SAMPLES[hold], min(lengths))
    start = torch.minimum(torch.maximum(row - (count // 2 - 1), first), last - count + 1)
    windows, own = torch.unique_consecutive(start, return_inverse=True)
    near = windows + torch.arange(count, device=u.device)[:, None]  # (count, W)
    weighted = u[near] / torch.stack(_denominators(list(t[near])))[..., None]
    value = torch.zeros_like(u[row])
    for numerator, of_node in zip(_numerators([x[own] - time for x in t[near]]), weighted, strict=True):
        value += numerator[..., None] * of_node[own]
    return value


def lagrange(x: Tensor) -> Tensor:
    """Weights of values at the nodes x in the polynomial through them at 0, Π_{j ≠ i} x_j / (x_j − x_i); (..., k)."""
    nodes = list(x.unbind(-1))
    return torch.stack([a / b for a, b in zip(_numerators(nodes), _denominators(nodes), strict=True)], -1)


def _numerators(nodes: Sequence[Tensor]) -> list[Tensor]:
    """Π_{j ≠ i} x_j for each node i: the product of the nodes before, times the product of the nodes after."""
    before, after = [torch.ones_like(nodes[0])], [torch.ones_like(nodes[0])]
    for k in range(len(nodes) - 1):
        before.append(before[-1] * nodes[k])
        after.append(after[-1] * nodes[-1 - k])
    return [a * b for a, b in zip(before, reversed(after), strict=True)]


def _denominators(nodes: Sequence[Tensor]) -> list[Tensor]:
    """Π_{j ≠ i} (x_j − x_i) for each node i."""
    return [
        math.prod((other - own for other in (*nodes[:i], *nodes[i + 1 :])), start=torch.ones_like(own))
        for i, own in enumerate(nodes)
    ]


# Readings through which a cubic gives the value between them.
CUBIC_POINTS = 4


def interpolated(t: Tensor, q: Tensor, known: Tensor, lengths: tuple[int, ...]) -> Tensor:
    """Positions (N, n); those that are not `known`, (N, n) bool, are on cubics through the known positions."""
    q = q.clone()
    for x, own in zip(q.T, known.T, strict=True):
        for time, part, read in zip(t.split(lengths), x.split(lengths), own.split(lengths), strict=True):
            if bool(read.any()):
                part[~read] = between(time[read], part[read], time[~read])
    return q


def between(t: Tensor, x: Tensor, at: Tensor) -> Tensor:
    """Values (M,) at other times of cubics through the nearest four readings (t, x), or through all if fewer."""
    count = min(CUBIC_POINTS, len(t))
    first = (torch.searchsorted(t, at) - count // 2).clamp(0, len(t) - count)
    near = first[:, None] + torch.arange(count, device=t.device)
    return (lagrange(t[near] - at[:, None]) * x[near]).sum(1)


def last_read(q: Tensor, known: Tensor, trajectory: Tensor) -> Tensor:
    """Positions (N, n); in place of a position that is not `known`, (N, n) bool, stands the last known position."""
    row = torch.arange(len(q), device=q.device)[:, None]
    first = torch.searchsorted(trajectory, trajectory)[:, None]
    return q.gather(0, torch.where(known, row, first).cummax(0).values)
