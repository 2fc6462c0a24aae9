"""The hold of an input between samples: how the recorded u_k become the input of a step, or of a part of it.

    zero     u_k from sample k to the next: a controller's output
    first    straight lines between the samples: the mean over a step is (u_k + u_{k+1})/2
    smooth   polynomials through eight samples: a signal without steps, sampled at the same times as the motion

A model takes one input a step. Where u changes within the step the rule of order 2 needs the value in the middle: a
hold gives the value, for the whole recorded step or for each of the equal parts in which the step is crossed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.errors import InputError

# Samples through which each hold draws its polynomial.
SAMPLES = {"zero": 1, "first": 2, "smooth": 8}
HOLDS = tuple(SAMPLES)


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
    near = start[..., None] + torch.arange(count, device=u.device)  # (..., count)
    x = t[near] - time[..., None]
    return (lagrange(x)[..., None] * u[near]).sum(-2)


def lagrange(x: Tensor) -> Tensor:
    """Weights of values at the nodes x in the polynomial through them at 0, Π_{j ≠ i} x_j / (x_j − x_i); (..., k)."""
    # Node by node: all pairs of nodes at once take ten times as long, and the memory of a square.
    weights = []
    for i, own in enumerate(nodes := x.unbind(-1)):
        weight = torch.ones_like(own)
        for other in nodes[:i] + nodes[i + 1 :]:
            weight = weight * (other / (other - own))
        weights.append(weight)
    return torch.stack(weights, -1)
