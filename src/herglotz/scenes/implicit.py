"""Solve x = g(x) for a few unknowns per sample, with derivatives that are exact up to the third.

The quadrature rules whose action sits at an unknown s, and the adjoint of a discrete Lagrangian, are equations of
this form.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.mechanics.newton import find_root, solve
from herglotz.theory.continuous import jacobian

MAX_NEWTON = 30  # ends a scalar equation without a solution
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
    start = start.detach()
    eye = torch.eye(start.shape[-1], dtype=start.dtype, device=start.device)

    def equations(x: Tensor) -> tuple[Tensor, Tensor]:
        value, slope = jacobian(g, x)
        return x - value, eye - slope

    # The move after one below √eps is below rounding.
    root = find_root(
        equations, start, 1.0 + start.abs(), iterations=MAX_NEWTON, tol=torch.finfo(start.dtype).eps ** 0.5
    )
    x = root.x + root.move
    if torch.is_grad_enabled() and g(x).requires_grad:
        for _ in range(EXACT_DERIVATIVES):
            x = x - solve(root.J, x - g(x))
    return torch.where(root.converged[..., None], x, torch.nan)
