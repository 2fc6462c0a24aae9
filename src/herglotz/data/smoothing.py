"""Velocities and accelerations of noisy recordings: a polynomial in time through a window around each sample.

Width and degree are those whose accelerations err least: noise asks for wide windows, motion between samples for narrow
ones. What is read off starts a fit and does not end one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.data.trajectories import Trajectories
from herglotz.data.windows import Triples

DEGREES = (4, 6)  # even: at the middle of a window an odd power says nothing about position and acceleration
WIDTHS = (7, 9, 11, 15, 21, 29, 41, 57, 81, 113, 161)  # odd, each about √2 times the one before
EXCESS = 1.2  # squared residuals beyond so many times the least are motion that the polynomials miss
NEAR = 0.02  # of a window's half width: steps so short that the rule's own error does not count
MOST = 2000  # windows that the choice looks at


@dataclass(frozen=True)
class LocalPolynomials:
    """The polynomial of each sample, in x = (t − t_k) / half."""

    width: int
    coefficients: Tensor  # (N, degree + 1, n)
    half: Tensor  # (N,) half the time that the window spans
    centred: Tensor  # (N,) bool: the window has as many samples before t_k as behind
    rows: Tensor  # (N, width) samples of the window

    def at(self, x: Tensor | float) -> Tensor:
        """Positions at x of every window, (N, n)."""
        x = torch.as_tensor(x, dtype=self.half.dtype).expand_as(self.half)
        powers = torch.stack([x**k for k in range(self.coefficients.shape[1])], -1)
        return (powers[..., None] * self.coefficients).sum(1)


def local_polynomials(data: Trajectories) -> LocalPolynomials | None:
    """The local polynomials of the best width and degree; None where no trajectory has seven samples."""
    tried = []
    for width in WIDTHS:
        if width > max(7, min(data.lengths) // 2) or width > min(data.lengths):
            break
        for degree in DEGREES:
            if width >= degree + 3:
                tried.append((width, degree, *_quality(data, width, degree)))
    if not tried:
        return None
    noise = min(left for _, _, left, _ in tried)
    fair = [x for x in tried if x[2] <= EXCESS * noise]
    # A residual beyond the noise is a run of one sign, which an acceleration takes over whole; noise averages out.
    width, degree, _, _ = min(fair, key=lambda x: (noise + x[0] * (x[2] - noise)) * x[3])
    rows = _windows(data, width)
    half, A = _design(data, rows, degree)
    coefficients = _inverse(A) @ data.q[rows].double()
    middle = rows[:, width // 2] == torch.arange(data.samples)
    return LocalPolynomials(width, coefficients, half, middle, rows)


def smoothed(data: Trajectories, local: LocalPolynomials | None = None) -> Trajectories:
    """The recordings with positions on local polynomials, by default their own; as they are where they have none."""
    local = local or local_polynomials(data)
    return data if local is None else replace(data, q=local.at(0.0).to(data.q))


def smooth_triples(data: Trajectories, local: LocalPolynomials) -> tuple[Triples, Tensor | None]:
    """Three positions on each polynomial, a short time apart, and the inputs (T, m) averaged over its window."""
    every = local.centred.nonzero()[:, 0]
    q0, q1, q2 = (local.at(x)[every] for x in (-NEAR, 0.0, NEAR))
    h = NEAR * local.half[every]
    u = None
    if data.u is not None:
        rows = local.rows[every]
        t = data.t[rows].double()
        middle = (t[:, 1:] + t[:, :-1]) / 2 - data.t[every].double()[:, None]
        weight = (1 - (middle / local.half[every][:, None]).square()).clamp_min(0).square() * t.diff(dim=1)
        u = (weight[..., None] * data.u[rows[:, :-1]].double()).sum(1) / weight.sum(1, keepdim=True)
    like = data.q
    q0, q1, q2, h = (x.to(like) for x in (q0, q1, q2, h))
    found = Triples(q0, q1, q2, h, h, every)
    return found, None if u is None else u.to(like)


def _quality(data: Trajectories, width: int, degree: int) -> tuple[float, float]:
    """Mean squared residual by its degrees of freedom, and the noise's factor in the acceleration, squared."""
    rows = _windows(data, width)
    inside = rows[:, width // 2] == torch.arange(data.samples)
    rows = rows[inside]
    rows = rows[:: -(-len(rows) // MOST)]
    half, A = _design(data, rows, degree)
    q = data.q[rows].double()
    inverse = _inverse(A)
    left = (q - A @ (inverse @ q)).square().mean() * width / (width - degree - 1)
    gain = (2 * inverse[:, 2] / half[:, None].square()).square().sum(1).mean()
    return float(left), float(gain)


def _inverse(A: Tensor) -> Tensor:
    """The pseudo-inverse of tall matrices of full rank."""
    Q, R = torch.linalg.qr(A)
    return torch.linalg.solve_triangular(R, Q.mT, upper=True)


def _windows(data: Trajectories, width: int) -> Tensor:
    """(N, width) samples around each, shifted inwards at the ends of a trajectory."""
    parts = []
    for first, length in zip(data.offsets, data.lengths, strict=True):
        start = (torch.arange(length) - width // 2).clamp(0, length - width)
        parts.append(first + start[:, None] + torch.arange(width))
    return torch.cat(parts)


def _design(data: Trajectories, rows: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """Half the span of each window, and its powers of time, (N, width, degree + 1)."""
    t = data.t[rows].double()
    own = data.t.double()[torch.arange(data.samples)] if len(rows) == data.samples else t[:, rows.shape[1] // 2]
    half = (t[:, -1] - t[:, 0]) / 2
    x = (t - own[:, None]) / half[:, None]
    return half, torch.stack([x**k for k in range(degree + 1)], -1)
