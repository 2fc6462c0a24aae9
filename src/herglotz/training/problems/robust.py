"""A robust loss: Student's t, by iteratively re-weighted least squares inside Gauss–Newton.

The negative log-likelihood of t-distributed residuals r (in units of their scale),

    ρ(r) = (ν + 1)/2 · log(1 + r²/ν),    ρ′(r) = w r,    w(r) = (ν + 1)/(ν + r²),

is proportional to r² near 0 and to log r far away: a gross error, or an unmodelled push, has almost no weight. w is
exact in the gradient and drops only the negative part of the Hessian, so JᵀWJ stays positive definite (Lange, Little &
Taylor 1989).
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data.noise import TAIL
from herglotz.least_squares import least_squares

# ν, with 96 % efficiency for normal residuals.
FREEDOM = 4.0
# Residuals are heavy-tailed if more than this share are outliers, or if one exceeds FAR robust standard deviations.
SHARE, FAR = 3e-3, 10.0
# Largest share of samples that may be left out as outliers; with more, a heavy-tailed loss is needed.
FEW = 0.1
# Re-weightings of a linear robust fit.
ROUNDS = 10
# Standard deviation over median absolute deviation of a normal distribution.
MAD = 1.4826


def loss(r: Tensor, freedom: float | None) -> Tensor:
    """Σ ρ(r), a scalar; Σ ½r² if `freedom` is None."""
    if freedom is None:
        return r.square().sum() / 2
    return (freedom + 1) / 2 * torch.log1p(r.square() / freedom).sum()


def root_weights(r: Tensor, freedom: float | None) -> Tensor:
    """√w(r), which multiplies rows of J and r; 1 if `freedom` is None."""
    return torch.ones_like(r) if freedom is None else ((freedom + 1) / (freedom + r.square())).sqrt()


def robust_fit(A: Tensor, b: Tensor) -> Tensor:
    """Solve A x ≈ b by Student's t instead of least squares, with re-weighting; A (..., m, k), b (..., m, 1)."""
    x = least_squares(A, b)
    for _ in range(ROUNDS):
        r = A @ x - b
        scale = MAD * r.abs().median(-2, keepdim=True).values.clamp_min(torch.finfo(r.dtype).tiny)
        by = root_weights(r / scale, FREEDOM)
        x = least_squares(by * A, by * b)
    return x


def scale_of(r: Tensor) -> float:
    """Standard deviation of the bulk of r, from its median absolute value."""
    return MAD * float(r.abs().median())


def far_out(r: Tensor) -> Tensor:
    """Rows of r, (N, n), with an outlier by the scale of all of r, (N,) bool."""
    return (r.abs() > TAIL * scale_of(r)).any(-1)


def heavy_tailed(r: Tensor) -> bool:
    """True if r has far more outliers than normal residuals of the same scale."""
    out = r.abs() / max(scale_of(r), torch.finfo(r.dtype).tiny)
    return float((out > TAIL).double().mean()) > SHARE or float(out.max()) > FAR
