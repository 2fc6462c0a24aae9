"""Windows on a concatenation of trajectories: steps, three samples, continuous angles, polynomials in time.

`trajectory` (N,) says which trajectory each row belongs to; no window joins two trajectories.
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
    """All windows of three consecutive samples of a trajectory, which a discrete Herglotz residual joins."""

    q0: Tensor  # (T, n) positions q_{k−1}, q_k, q_{k+1}
    q1: Tensor  # (T, n)
    q2: Tensor  # (T, n)
    h0: Tensor  # (T,) from q0 to q1
    h1: Tensor  # (T,) from q1 to q2
    index: Tensor  # (T,) long, row of q0 in the concatenation

    def __len__(self) -> int:
        return len(self.index)

    @property
    def v(self) -> Tensor:
        """Velocities by differences of q2 and q0, (T, n)."""
        return (self.q2 - self.q0) / (self.h0 + self.h1)[:, None]

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
    max_step: float | None = None,
) -> Triples:
    """Return every window of three consecutive samples, without windows that have a step longer than `max_step`."""
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
    """Remove the multiple of 2π from every jump longer than π; each trajectory keeps the first value.

    A sample between both ends of a jump, as in a resampled or filtered angle, leaves two steps of less than π. Their
    turn is removed if the motion on either side of the sample then continues across the sample. A sensor that wraps
    leaps by its range, or twice by half its range: if no step is longer than a quarter of the range, the sensor itself
    counted all turns.
    """
    inside = (trajectory[1:] == trajectory[:-1])[:, None] & angles
    inside &= _wraps(q, trajectory)[trajectory[1:]]
    turns = torch.zeros_like(q)
    turns[1:] = torch.where(inside, torch.round((q[1:] - q[:-1]) / (2 * torch.pi)), 0.0)
    turns[1:] += torch.where(inside, _divided_turns(q - 2 * torch.pi * turns.cumsum(0), trajectory)[1:], 0.0)
    total = turns.cumsum(0)
    # The row at which the trajectory of each row starts.
    first = torch.searchsorted(trajectory, trajectory)
    return q - 2 * torch.pi * (total - total[first])


def _wraps(q: Tensor, trajectory: Tensor) -> Tensor:
    """Whether each trajectory has a step of a quarter of the range, (B, n)."""
    rows = trajectory[:, None].expand_as(q)
    empty = q.new_zeros(int(trajectory[-1]) + 1, q.shape[1])
    high, low = (empty.scatter_reduce(0, rows, q, how, include_self=False) for how in ("amax", "amin"))
    step = torch.where(rows[1:] == rows[:-1], q.diff(dim=0).abs(), 0.0)
    return 4 * empty.scatter_reduce(0, rows[1:], step, "amax") >= high - low


def _divided_turns(q: Tensor, trajectory: Tensor) -> Tensor:
    """Turns that a step and the next step make together, (N, n), at the end of the second step.

    Two steps together are as long as the step before and the step after, up to whole turns. The steps on either side
    have to agree, so that a wrong sample is not taken for a turn.
    """
    turns, step = torch.zeros_like(q), q.diff(dim=0)
    if len(q) < 7:
        return turns
    # Two steps on either side of the two steps that may share a turn.
    before, near, far, behind = step[:-5], step[1:-4], step[4:-1], step[5:]
    across = q[4:-2] - q[2:-4]
    found = torch.round((across - near - far) / (2 * torch.pi))
    smooth = torch.stack([near - before, behind - far, far - near, across - near - far - 2 * torch.pi * found]).abs()
    one = (trajectory[6:] == trajectory[:-6])[:, None]
    turns[4:-2] = torch.where(one & (smooth < torch.pi / 2).all(0), found, 0.0)
    return turns


# Of half a window's width: times that differ by less are alike, but for the rounding of t / h.
ROUNDED = 1e-11


def rounding(t: Tensor, half: Tensor) -> float:
    """The rounding of the times t of a clock in windows that span 2 `half`, over `half`; at least `ROUNDED`."""
    return max(ROUNDED, 4 * torch.finfo(torch.float64).eps * float(t.abs().max() / half.min()))


def powers(x: Tensor, degree: int) -> Tensor:
    """1, x, x² … of the times of windows, (N, w) → (N, w, degree + 1)."""
    return torch.stack([x**k for k in range(degree + 1)], -1)


def pseudo_inverses(x: Tensor, degree: int, rounded: float = ROUNDED) -> Tensor:
    """What turns values at times x (N, w), about 1 in size, into the coefficients of `powers`, (N, degree + 1, w).

    Most windows of even steps have the same times, but for what is `rounded`, and share a matrix; (1, degree + 1, w) if
    all do.
    """
    # The middle of all windows may be the end of a recording, whose window lies otherwise than most.
    begin = (x[:, 0] / ROUNDED).round()
    begins, counts = torch.unique(begin, return_counts=True)
    usual = x[begin == begins[counts.argmax()]]
    middle = x[len(x) // 2]
    middle = middle if abs(float(middle[0] - usual[0, 0])) <= rounded else usual[len(usual) // 2]
    others = (x - middle).abs().amax(1) > rounded
    Q, R = torch.linalg.qr(powers(torch.cat([middle[None], x[others]]), degree))
    inverses = torch.linalg.solve_triangular(R, Q.mT, upper=True)
    if len(inverses) == 1:
        return inverses
    every = inverses[:1].repeat(len(x), 1, 1)
    every[others] = inverses[1:]
    return every
