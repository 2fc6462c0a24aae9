"""A loss that outliers cannot pull: Student's t, by iteratively re-weighted least squares inside Gauss–Newton.

The negative log-likelihood of t-distributed residuals r (in units of their scale),

    ρ(r) = (ν + 1)/2 · log(1 + r²/ν),    ρ′(r) = w r,    w(r) = (ν + 1)/(ν + r²),

is ½r² near 0 but for a factor and grows like log r far away: a gross error, or a push that no model knows of, has next
to no weight. w is exact in the gradient and drops only the negative part of the Hessian, so JᵀWJ stays positive
definite (Lange, Little & Taylor 1989).
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.least_squares import least_squares

FREEDOM = 4.0  # ν: 96 % of the normal distribution's efficiency where the residuals are normal
TAIL = 5.0  # residuals beyond so many robust standard deviations are outliers: 6e-7 of normal ones are
SHARE = 3e-3  # share of outliers above which residuals count as heavy-tailed,
FAR = 10.0  # or one that is so far out
FEW = 0.1  # share of samples that may be left out one by one; more, and only a heavy-tailed loss is honest
MAD = 1.4826  # standard deviation over median absolute deviation, of a normal distribution


def loss(r: Tensor, freedom: float | None) -> Tensor:
    """Sum of ρ(r), a scalar; of ½r² without a `freedom`."""
    if freedom is None:
        return r.square().sum() / 2
    return (freedom + 1) / 2 * torch.log1p(r.square() / freedom).sum()


def root_weights(r: Tensor, freedom: float | None) -> Tensor:
    """√w(r): multiplies rows of J and r; 1 without a `freedom`."""
    return torch.ones_like(r) if freedom is None else ((freedom + 1) / (freedom + r.square())).sqrt()


def robust_fit(A: Tensor, b: Tensor, rounds: int = 10) -> Tensor:
    """X of A x ≈ b by Student's t instead of least squares, by re-weighting; A (..., m, k), b (..., m, 1)."""
    x = least_squares(A, b)
    for _ in range(rounds):
        r = A @ x - b
        scale = MAD * r.abs().median(-2, keepdim=True).values.clamp_min(torch.finfo(r.dtype).tiny)
        by = root_weights(r / scale, FREEDOM)
        x = least_squares(by * A, by * b)
    return x


def scale_of(r: Tensor) -> float:
    """Standard deviation of the bulk of r, from its median absolute value."""
    return MAD * float(r.abs().median())


def far_out(r: Tensor) -> Tensor:
    """Which rows of r, (N, n), hold an outlier of the scale of all of it, (N,) bool."""
    return (r.abs() > TAIL * scale_of(r)).any(-1)


def heavy_tailed(r: Tensor) -> bool:
    """Whether r has far more outliers than normal residuals of its own scale could."""
    out = r.abs() / max(scale_of(r), torch.finfo(r.dtype).tiny)
    return float((out > TAIL).double().mean()) > SHARE or float(out.max()) > FAR
