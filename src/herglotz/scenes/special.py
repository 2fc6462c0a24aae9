"""cos and sin(·)/· as analytic functions of the square of their argument, and the step as a tensor.

With x = ω²h² one formula covers under-damped (x > 0), critical (x = 0) and over-damped (x < 0) motion.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

# At |x| ≤ 1 the first dropped term, x¹³/26!, and its second derivative, 156 x¹¹/26!, are below 1e-24.
TERMS = 13


def cosw(x: Tensor) -> Tensor:
    """Cos √x for x ≥ 0, cosh √−x for x < 0; entire in x, any number of derivatives.

    For |x| ≤ 1 the series is used, because derivatives of the closed form lose digits like 1/x and are NaN at 0.
    """
    root = _far_root(x)
    far = torch.where(x > 0, torch.cos(root), torch.cosh(root))
    return torch.where(x.abs() > 1.0, far, _series(x, 0))


def sincw(x: Tensor) -> Tensor:
    """sin(√x)/√x for x > 0, 1 at 0, sinh(√−x)/√−x for x < 0; entire in x, any number of derivatives."""
    root = _far_root(x)
    far = torch.where(x > 0, torch.sin(root), torch.sinh(root)) / root
    return torch.where(x.abs() > 1.0, far, _series(x, 1))


def versw(x: Tensor) -> Tensor:
    """1 − cosw(x) without cancellation: (x/2) sincw(x/4)²."""
    return 0.5 * x * sincw(0.25 * x) ** 2


def expm1w(x: Tensor) -> Tensor:
    """(eˣ − 1)/x, 1 at 0; entire in x, any number of derivatives: e^{x/2} sinh(x/2)/(x/2)."""
    return torch.exp(0.5 * x) * sincw(-0.25 * x * x)


def as_step(h: Tensor | float, like: Tensor) -> Tensor:
    """The time step h, a number or a tensor, in the dtype and on the device of `like`."""
    return torch.as_tensor(h, dtype=like.dtype, device=like.device)


def _far_root(x: Tensor) -> Tensor:
    """√|x| where |x| > 1, else 1, so that the branch that is not taken has finite derivatives."""
    return torch.sqrt(torch.where(x.abs() > 1.0, x.abs(), 1.0))


def _series(x: Tensor, shift: int) -> Tensor:
    """Σ_k (−x)^k / (2k + shift)!, by Horner's rule."""
    x = torch.where(x.abs() > 1.0, 0.0, x)
    total = torch.zeros_like(x)
    for k in reversed(range(TERMS)):
        total = 1.0 / math.factorial(2 * k + shift) - x * total
    return total
