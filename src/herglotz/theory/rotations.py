"""Rotations: hat and vee, exponential, logarithm and Cayley map of SO(3), each analytic at the identity.

`torch.matrix_exp` loses 1.5e-11 near |w| = 0.03; Rodrigues' formula with a series for small angles loses nothing.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

TERMS = 10  # at θ² ≤ 1 the first term left out is below 1/21!, 2e-20


def hat(w: Tensor) -> Tensor:
    """The matrix of w ×, (..., 3) → (..., 3, 3)."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def vee(W: Tensor) -> Tensor:
    """Inverse of `hat` on the antisymmetric part of W, (..., 3, 3) → (..., 3)."""
    return 0.5 * torch.stack(
        [W[..., 2, 1] - W[..., 1, 2], W[..., 0, 2] - W[..., 2, 0], W[..., 1, 0] - W[..., 0, 1]], -1
    )


def exp_so3(w: Tensor) -> Tensor:
    """exp(ŵ) = I + (sin θ/θ) ŵ + ((1 − cos θ)/θ²) ŵ², θ = |w|: Rodrigues' formula.

    Parameters
    ----------
    w
        (..., 3) rotation vector, rad.

    Returns
    -------
    Tensor
        (..., 3, 3), orthogonal to rounding; differentiable everywhere, w = 0 included.
    """
    x = (w * w).sum(-1)
    W = hat(w)
    eye = torch.eye(3, dtype=w.dtype, device=w.device)
    a, b = (y[..., None, None] for y in (_sinc(x), 0.5 * _sinc(0.25 * x) ** 2))
    return eye + a * W + b * (W @ W)


def log_so3(R: Tensor) -> Tensor:
    """The rotation vector w, |w| ≤ π, with exp(ŵ) = R.

    Through the unit quaternion, whose largest component is taken from the diagonal first (Shepperd 1978): no digits are
    lost near the identity nor near θ = π, where the sign of w is arbitrary.

    Parameters
    ----------
    R
        (..., 3, 3) rotation.

    Returns
    -------
    Tensor
        (..., 3).
    """
    real, imaginary = _quaternion(R)
    sine = imaginary.norm(dim=-1)
    small = sine < 1e-4
    safe = torch.where(small, 1.0, sine)
    far = 2.0 * torch.atan2(safe, real) / safe
    near = 2.0 / real * (1.0 - (sine / real) ** 2 / 3.0)  # real is near 1 there: the signs are chosen so
    return torch.where(small, near, far)[..., None] * imaginary


def cayley(f: Tensor) -> Tensor:
    """(I + f̂)(I − f̂)⁻¹ = I + 2(f̂ + f̂²)/(1 + |f|²): the rotation about f by 2 arctan |f|; all but θ = π.

    Parameters
    ----------
    f
        (..., 3), any size.

    Returns
    -------
    Tensor
        (..., 3, 3).
    """
    F = hat(f)
    eye = torch.eye(3, dtype=f.dtype, device=f.device)
    return eye + 2.0 / (1.0 + (f * f).sum(-1))[..., None, None] * (F + F @ F)


def inverse_cayley(R: Tensor) -> Tensor:
    """The f with cayley(f) = R, shape (..., 3); not finite for rotations by π."""
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)
    return 2.0 * vee(R) / (1.0 + trace)[..., None]


def _sinc(x: Tensor) -> Tensor:
    """sin(√x)/√x for x ≥ 0, entire in x."""
    near = x <= 1.0
    root = torch.sqrt(torch.where(near, 1.0, x))  # the branch not taken keeps finite derivatives
    y = torch.where(near, x, 0.0)
    series = torch.zeros_like(x)
    for k in reversed(range(TERMS)):
        series = 1.0 / math.factorial(2 * k + 1) - y * series
    return torch.where(near, series, torch.sin(root) / root)


def _quaternion(R: Tensor) -> tuple[Tensor, Tensor]:
    """Real part ≥ 0, (...), and imaginary part, (..., 3)."""
    diagonal = R.diagonal(dim1=-2, dim2=-1)
    trace = diagonal.sum(-1)
    v = 2.0 * vee(R)  # 4 · real · imaginary
    # Four times the outer product of the quaternion with itself; its row of largest diagonal is the best direction.
    corner = (1.0 + trace)[..., None, None]
    block = R + R.mT
    block = block + torch.diag_embed((1.0 - trace)[..., None].expand_as(v))
    outer = torch.cat([torch.cat([corner, v[..., None, :]], -1), torch.cat([v[..., :, None], block], -1)], -2)
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    quaternion = row / row.norm(dim=-1, keepdim=True)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    return quaternion[..., 0], quaternion[..., 1:]
