"""Windows on a concatenation of trajectories: steps, three-sample windows and continuous angles.

`trajectory` (N,) says which trajectory each row belongs to; no window joins two of them.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from herglotz.data.checks import check_positive


@dataclass(frozen=True)
class Steps:
    """All steps inside trajectories; none joins two trajectories."""

    h: Tensor  # (N-B,) t_{k+1} - t_k
    trajectory: Tensor  # (N-B,) long
    index: Tensor  # (N-B,) long, row of the concatenation where the step starts


@dataclass(frozen=True)
class Triples:
    """All windows of three consecutive samples of one trajectory; one discrete Herglotz residual joins three."""

    q0: Tensor  # (T, n) positions q_{k−1}, q_k, q_{k+1}
    q1: Tensor  # (T, n)
    q2: Tensor  # (T, n)
    h0: Tensor  # (T,) from q0 to q1
    h1: Tensor  # (T,) from q1 to q2
    index: Tensor  # (T,) long, row of q0 in the concatenation

    def __len__(self) -> int:
        return len(self.index)

    def spread_out(self, most: int) -> Triples:
        """Return at most `most` windows, evenly spread."""
        if len(self) <= most:
            return self
        rows = torch.linspace(0, len(self) - 1, most, device=self.index.device).round().long()
        return Triples(*(getattr(self, field.name)[rows] for field in fields(self)))


def triples(
    t: Tensor,  # (N,) time
    q: Tensor,  # (N, n) position
    trajectory: Tensor,  # (N,) long
    max_step: float | None = None,  # leave out windows with a longer step
) -> Triples:
    """Return every window of three consecutive samples."""
    index = (trajectory[2:] == trajectory[:-2]).nonzero()[:, 0]
    h0, h1 = t[index + 1] - t[index], t[index + 2] - t[index + 1]
    if max_step is not None:
        check_positive("max_step", max_step)
        keep = (h0 <= max_step) & (h1 <= max_step)
        index, h0, h1 = index[keep], h0[keep], h1[keep]
    return Triples(q[index], q[index + 1], q[index + 2], h0, h1, index)


def join(first: Triples, second: Triples) -> Triples:
    """Return the windows of both, one after the other."""
    pairs = zip(vars(first).values(), vars(second).values(), strict=True)
    return Triples(*(torch.cat(pair) for pair in pairs))


def unwrap(
    q: Tensor,  # (N, n) position
    trajectory: Tensor,  # (N,) long
    angles: Tensor,  # (n,) bool, the columns to make continuous
) -> Tensor:
    """Remove the multiple of 2π from every jump longer than π; each trajectory keeps its first value."""
    inside = (trajectory[1:] == trajectory[:-1])[:, None] & angles
    turns = torch.zeros_like(q)
    turns[1:] = torch.where(inside, torch.round((q[1:] - q[:-1]) / (2 * torch.pi)), 0.0)
    total = turns.cumsum(0)
    first = torch.searchsorted(trajectory, trajectory)  # row at which each row's trajectory starts
    return q - 2 * torch.pi * (total - total[first])
