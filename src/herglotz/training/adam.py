"""Adam, for comparison with Levenberg–Marquardt and for models too large for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from herglotz.training.levenberg_marquardt import OptimiserResult


class Differentiable(Protocol):
    """A scalar objective with its gradient."""

    def cost_and_gradient(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(cost, ∂cost/∂x)."""
        ...


def adam(
    problem: Differentiable,
    x: Tensor,
    *,
    max_iterations: int = 2000,
    learning_rate: float = 3e-3,
    callback: Callable[[int, float, Tensor], None] | None = None,
) -> OptimiserResult:
    """Full-batch Adam with a cosine schedule; returns the best finite point visited.

    Parameters
    ----------
    problem
        The objective.
    x
        (P,) start.
    max_iterations, learning_rate
        Length and peak of the cosine schedule.
    callback
        Called with (iteration, best cost, best x).
    """
    current = x.clone().requires_grad_()
    optimiser = torch.optim.Adam([current], lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max_iterations)
    best, best_x, history, reason = float("inf"), x, [], "max_iterations"
    iteration = 0
    for iteration in range(1, max_iterations + 1):
        cost, gradient = problem.cost_and_gradient(current.detach())
        if not bool(torch.isfinite(cost)) or not bool(torch.isfinite(gradient).all()):
            reason = "not_finite"
            break
        if float(cost) < best:
            best, best_x = float(cost), current.detach().clone()
            history.append(best)
        current.grad = gradient
        optimiser.step()
        schedule.step()
        if callback is not None:
            callback(iteration, best, best_x)
    return OptimiserResult(best_x, best, reason, iteration, history)
