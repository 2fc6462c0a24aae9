"""Levenberg–Marquardt with Marquardt's diagonal scaling, on normal equations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from herglotz.progress import beat
from herglotz.training.arrowhead import Arrowhead
from herglotz.training.distributed import everywhere, of_first

# A smaller relative change of the cost is the rounding of a long sum.
ROUNDING = 1e-11
# Factor of the damping after the first rejected step; the factor doubles with each further one.
GROWTH = 2.0
# Below this damping λ a step is a Newton step. The search ends if it predicts less than this share of the tolerance.
NEWTON_DAMPING, NEGLIGIBLE = 1e-6, 0.01


# (½|r|², JᵀJ, Jᵀr)
Equations = tuple[Tensor, Tensor | Arrowhead, Tensor]


class SumOfSquares(Protocol):
    """A sum of squares ½|r(x)|² (inf or NaN if x is not admissible), and its (½|r|², JᵀJ, Jᵀr), perhaps in chunks.

    A problem with an attribute `at_once` that is true computes the normal equations in little more time than the cost.
    """

    def cost(self, x: Tensor) -> Tensor: ...  # noqa: D102
    def normal_equations(self, x: Tensor) -> Equations: ...  # noqa: D102


class Progress(Protocol):
    """Called after each iteration; `search()` gives the state of the search as plain values.

    `resumed` is that state from an interrupted run (None: start from x).
    """

    resumed: dict[str, Any] | None

    def __call__(self, iteration: int, cost: float, x: Tensor, search: Callable[[], Any], /) -> None: ...  # noqa: D102


def memory_of(problem: Any) -> dict[str, Any]:
    """The start values that a problem, or the problem inside it, keeps for its next evaluation; {} for most."""
    inner = getattr(problem, "problem", problem)
    return inner.memory() if hasattr(inner, "memory") else {}


def remind(problem: Any, memory: dict[str, Any]) -> None:
    """Inverse of `memory_of`."""
    if memory:
        getattr(problem, "problem", problem).recall(memory)


@dataclass
class OptimiserResult:
    """The best point, the accepted costs, and why the search ended.

    `reason` is "converged", "max_iterations", "no_descent" or "not_finite"; `memory` is that of the problem at the end.
    """

    x: Tensor
    cost: float
    reason: str
    iterations: int
    history: list[float] = field(default_factory=list)
    memory: dict[str, Any] = field(default_factory=dict)


@dataclass
class _Search:
    """The state of a search, without the normal equations at x."""

    x: Tensor
    best: float
    damping: float
    scale: Tensor
    history: list[float]
    growth: float = GROWTH
    quiet: int = 0
    iteration: int = 0

    def over(self, patience: int) -> str | None:
        """Why the search is over; None while it is not."""
        return "converged" if self.quiet >= patience else "no_descent" if self.damping > 1e12 else None


def levenberg_marquardt(
    problem: SumOfSquares,
    x: Tensor,  # (P,)
    *,
    max_iterations: int = 150,
    rtol: float = 1e-6,
    atol: float = 0.0,
    patience: int = 5,
    damping: float = 1e-3,
    callback: Progress | None = None,
) -> OptimiserResult:
    """Minimise ½|r(x)|² from the start x, in at most `max_iterations` accepted and rejected steps.

    Each iteration solves (JᵀJ + λ D) δ = −Jᵀr with D the running maximum of diag JᵀJ (Marquardt's scaling, Moré's
    monotone version) by Cholesky, or by eliminating the states of an `Arrowhead`; λ starts at `damping` and
    follows the ratio of actual to predicted decrease (Nielsen's rule).

    The search ends after `patience` accepted steps in a row that each lower the cost by less than `atol`, or `rtol`
    relative. A step that changes the cost only by rounding is not taken, but counts as such a step. The search ends at
    once if a Newton step predicts less than a hundredth of the tolerance. The result is the best finite point. A search
    resumed by the `callback` is bit-equal to an uninterrupted one.
    """
    resumed = None if callback is None else callback.resumed
    if resumed is not None:
        remind(problem, resumed["memory"])
        x = resumed["search"]["x"].to(x)
    cost, A, b = _of_first(problem.normal_equations(x))
    if not bool(torch.isfinite(cost)):
        return OptimiserResult(x, float(cost), "not_finite", 0)
    at = _Search(x, float(cost), damping, A.diagonal().clone(), [float(cost)])
    if resumed is not None:
        at = _Search(**{**resumed["search"], "x": x, "scale": resumed["search"]["scale"].to(x)})
    rounding = max(ROUNDING, 8 * torch.finfo(cost.dtype).eps)
    while at.iteration < max_iterations and at.over(patience) is None:
        at.iteration += 1
        beat()
        # Parameters without influence yet, behind a layer that starts at 0, get the largest scale.
        floor = float(at.scale.max()) or 1.0
        step = _damped_step(A, b, at.damping * torch.where(at.scale > 0, at.scale, floor))
        new, predicted, equations = math.inf, 0.0, None
        if step is not None:
            predicted = float(-(b @ step) - 0.5 * step @ (A @ step))
            if at.damping <= NEWTON_DAMPING and 0 <= predicted < NEGLIGIBLE * max(rtol * at.best, atol):
                at.quiet = patience
                break
            # Most steps are accepted, unless the step before was not.
            if getattr(problem, "at_once", False) and at.growth == GROWTH:
                equations = problem.normal_equations(at.x + step)
            new = float(of_first(problem.cost(at.x + step) if equations is None else equations[0])[0])
        # Rounding errors differ between machines; the search must not depend on their sign.
        settled = abs(at.best - new) <= rounding * at.best
        if step is not None and not settled and new < at.best and predicted > 0:
            gain = (at.best - new) / predicted
            at.quiet = at.quiet + 1 if at.best - new <= max(rtol * at.best, atol) else 0
            at.x = at.x + step
            cost, A, b = _of_first(problem.normal_equations(at.x) if equations is None else equations)
            at.best = float(cost)
            at.history.append(at.best)
            at.scale = torch.maximum(at.scale, A.diagonal())
            at.damping *= max(1 / 3, 1 - (2 * gain - 1) ** 3)
            at.damping, at.growth = max(at.damping, 1e-14), GROWTH
        else:
            at.quiet += settled
            at.damping, at.growth = at.damping * at.growth, at.growth * 2
        if callback is not None:
            callback(at.iteration, at.best, at.x, lambda: {"search": asdict(at), "memory": memory_of(problem)})
    reason = at.over(patience) or "max_iterations"
    return OptimiserResult(at.x, at.best, reason, at.iteration, at.history, memory_of(problem))


def _of_first(equations: Equations) -> Equations:
    """The equations of the first process; an `Arrowhead` is the same in every process."""
    cost, A, b = equations
    if isinstance(A, Tensor):
        (A,) = of_first(A)
    cost, b = of_first(cost, b)
    return cost, A, b


def _damped_step(A: Tensor | Arrowhead, b: Tensor, diagonal: Tensor) -> Tensor | None:
    if not isinstance(A, Tensor):
        step = A.solve(-b, diagonal)
        return step if everywhere(step is not None) else None
    # JᵀJ has the squared condition number of J, which needs float64.
    matrix = (A + torch.diag(diagonal)).double()
    factor, info = torch.linalg.cholesky_ex(matrix)
    if not everywhere(int(info) == 0):
        return None
    (step,) = of_first(-torch.cholesky_solve(b.double()[:, None], factor)[:, 0].to(b.dtype))
    return step if bool(torch.isfinite(step).all()) else None
