"""Levenberg–Marquardt with Marquardt's diagonal scaling, on normal equations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, cast

import torch
from torch import Tensor

from herglotz.training.distributed import everywhere, of_first

ROUNDING = 1e-11  # a change of the cost below this, relative, is the rounding of a long sum


class ByProducts(Protocol):
    """A matrix JᵀJ that is known by its products (`matrix_free`)."""

    def __matmul__(self, v: Tensor, /) -> Tensor:
        """JᵀJ v."""
        ...

    def diagonal(self) -> Tensor:
        """Its diagonal, or an estimate of it."""
        ...

    def solve(self, b: Tensor, damping: Tensor) -> Tensor | None:
        """(JᵀJ + diag(damping))⁻¹ b, or None where there is no finite one."""
        ...


class SumOfSquares(Protocol):
    """A sum of squares ½|r(x)|²; problems build JᵀJ and Jᵀr themselves, so that they may work in chunks."""

    def cost(self, x: Tensor) -> Tensor:
        """½|r|², a scalar; may be inf or nan where x is not admissible."""
        ...

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor] | tuple[Tensor, ByProducts, Tensor]:
        """(½|r|², JᵀJ, Jᵀr) at x."""
        ...


@dataclass
class OptimiserResult:
    """The best point found and how the search went."""

    x: Tensor
    cost: float
    reason: str  # "converged", "max_iterations", "no_descent" or "not_finite"
    iterations: int
    history: list[float] = field(default_factory=list)  # accepted costs


def levenberg_marquardt(
    problem: SumOfSquares,
    x: Tensor,
    *,
    max_iterations: int = 150,
    rtol: float = 1e-6,
    patience: int = 5,
    damping: float = 1e-3,
    callback: Callable[[int, float, Tensor], None] | None = None,
) -> OptimiserResult:
    """Minimise ½|r(x)|².

    Each iteration solves (JᵀJ + λ D) δ = −Jᵀr with D the running maximum of diag JᵀJ (Marquardt's scaling, Moré's
    monotone version) by Cholesky, or by conjugate gradients where JᵀJ is known by its products; λ follows the ratio of
    actual to predicted decrease (Nielsen's rule).

    Parameters
    ----------
    problem
        Supplies cost and normal equations.
    x
        (P,) start.
    max_iterations
        Bound on accepted and rejected steps together.
    rtol, patience
        Stop after `patience` accepted steps in a row that each lower the cost by less than `rtol` relative. A step
        that changes it by rounding only is not taken and counts as one of them.
    damping
        λ of the first step. Where few combinations of the unknowns are free beside the diagonal (smoothed states), it
        has to be far smaller than where all are.
    callback
        Called with (iteration, cost, x) after each iteration.

    Returns
    -------
    OptimiserResult
        Always the best finite point; `reason` tells why the search ended.
    """
    cost, A, b = _of_first(problem.normal_equations(x))
    best = float(cost)
    if not bool(torch.isfinite(cost)):
        return OptimiserResult(x, best, "not_finite", 0)
    scale = A.diagonal().clone()
    growth, quiet = 2.0, 0
    rounding = max(ROUNDING, 8 * torch.finfo(cost.dtype).eps)
    history, reason, iteration = [best], "max_iterations", 0
    for iteration in range(1, max_iterations + 1):
        step = _damped_step(A, b, damping * _floored(scale))
        new = of_first(problem.cost(x + step))[0] if step is not None else None
        predicted = 0.0 if step is None else float(-(b @ step) - 0.5 * step @ (A @ step))
        if new is not None and abs(best - float(new)) <= rounding * best:
            # Whether rounding lets the cost fall differs from machine to machine; the search must not depend on it.
            quiet += 1
            damping, growth = damping * growth, growth * 2
        elif step is not None and new is not None and bool(torch.isfinite(new)) and float(new) < best and predicted > 0:
            gain = (best - float(new)) / predicted
            quiet = quiet + 1 if best - float(new) <= rtol * best else 0
            x = x + step
            cost, A, b = _of_first(problem.normal_equations(x))
            best = float(cost)
            history.append(best)
            scale = torch.maximum(scale, A.diagonal())
            damping *= max(1 / 3, 1 - (2 * gain - 1) ** 3)
            damping, growth = max(damping, 1e-14), 2.0
        else:
            damping, growth = damping * growth, growth * 2
        if callback is not None:
            callback(iteration, best, x)
        if quiet >= patience:
            reason = "converged"
            break
        if damping > 1e12:
            reason = "no_descent"
            break
    return OptimiserResult(x, best, reason, iteration, history)


def _floored(scale: Tensor) -> Tensor:
    """Keep the scaling positive where a parameter has had no influence yet (behind a zero-initialised layer)."""
    largest = float(scale.max())
    return scale.clamp_min(1e-10 * largest if largest > 0 else 1.0)


Equations = tuple[Tensor, "Tensor | ByProducts", Tensor]


def _of_first(equations: Equations) -> Equations:
    """The first process's; products are the same everywhere already."""
    cost, A, b = equations
    if isinstance(A, Tensor):
        return cast(Equations, of_first(cost, A, b))
    cost, b = of_first(cost, b)
    return cost, A, b


def _damped_step(A: Tensor | ByProducts, b: Tensor, diagonal: Tensor) -> Tensor | None:
    if not isinstance(A, Tensor):
        step = A.solve(-b, diagonal)
        return step if everywhere(step is not None) else None
    matrix = (A + torch.diag(diagonal)).double()  # squared condition numbers need float64
    factor, info = torch.linalg.cholesky_ex(matrix)
    if not everywhere(int(info) == 0):
        return None
    step = -torch.cholesky_solve(b.double()[:, None], factor)[:, 0].to(b.dtype)
    (step,) = of_first(step)
    return step if bool(torch.isfinite(step).all()) else None
