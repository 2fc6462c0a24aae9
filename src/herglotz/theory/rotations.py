"""Rotations: the matrix of w × and the Cayley map of SO(3)."""

from __future__ import annotations

import torch
from torch import Tensor


def hat(w: Tensor) -> Tensor:
    """The matrix of w ×, (..., 3) → (..., 3, 3)."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def cayley(f: Tensor) -> Tensor:
    """(I + f̂)(I − f̂)⁻¹ = I + 2(f̂ + f̂²)/(1 + |f|²) of f (..., 3): the rotation by 2 arctan |f|; all but θ = π."""
    F = hat(f)
    eye = torch.eye(3, dtype=f.dtype, device=f.device)
    return eye + 2.0 / (1.0 + (f * f).sum(-1))[..., None, None] * (F + F @ F)
