"""Solve x = g(x) for a few unknowns per sample, with derivatives that are exact up to the third.

The quadrature rules whose action sits at an unknown s, and the adjoint of a discrete Lagrangian, are equations of
this form.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.theory.continuous import jacobian

MAX_NEWTON = 30
# With the Jacobian held fixed each Newton step inside the graph makes derivatives exact one order further.
EXACT_DERIVATIVES = 3


def fixed_point(
    g: Callable[[Tensor], Tensor],  # (..., k) → (..., k), samples apart
    start: Tensor,  # (..., k) of the full batch shape
) -> Tensor:
    """The solution x of x = g(x) by Newton's method from `start`, shape (..., k); NaN where it has not converged.

    Solved outside the graph. Where gradients are on and g wants them, further steps inside the graph carry the first
    three derivatives of x with respect to whatever g depends on.
    """
    x, inverse, converged = _solve(g, start.detach())
    if torch.is_grad_enabled() and g(x).requires_grad:
        for _ in range(EXACT_DERIVATIVES):
            x = x + (inverse @ (g(x) - x)[..., None])[..., 0]
    return torch.where(converged[..., None], x, torch.nan)


def _solve(g: Callable[[Tensor], Tensor], x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """x, (I − ∂g/∂x)⁻¹ and whether the iteration has converged."""
    with torch.no_grad():
        eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        tolerance = torch.finfo(x.dtype).eps ** 0.5  # the step after it is below round-off
        for _ in range(MAX_NEWTON):
            value, slope = jacobian(g, x)
            inverse = torch.linalg.inv_ex(eye - slope)[0]
            step = (inverse @ (value - x)[..., None])[..., 0]
            x = x + step
            converged = (step.abs() <= tolerance * (1.0 + x.abs())).all(-1)
            if bool(converged.all()):
                break
        return x, inverse, converged
