"""Levenberg–Marquardt with Marquardt's diagonal scaling, on normal equations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any, Protocol, cast

import torch
from torch import Tensor

from herglotz.progress import beat
from herglotz.training.distributed import everywhere, of_first

ROUNDING = 1e-11  # a change of the cost below this, relative, is the rounding of a long sum
FREE, LEFT = 1e-6, 0.01  # damping of steps that are Newton's, and the share of a quiet step that is not worth one


class ByProducts(Protocol):
    """A matrix JᵀJ with a structure of its own, which its products and its solver use."""

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


class Progress(Protocol):
    """What an optimiser reports to, and goes on from."""

    resumed: dict[str, Any] | None  # what `search` gave in the interrupted run; None: start from x

    def __call__(self, iteration: int, cost: float, x: Tensor, search: Callable[[], dict[str, Any]], /) -> None:
        """Called after each iteration; `search()` is all that decides how the search goes on, as plain values."""
        ...


def memory_of(problem: Any) -> dict[str, Any]:
    """What a problem, or the one inside it, remembers of its last evaluation and later ones start from; {} of most."""
    inner = getattr(problem, "problem", problem)
    return inner.memory() if hasattr(inner, "memory") else {}


def remind(problem: Any, memory: dict[str, Any]) -> None:
    """Inverse of `memory_of`."""
    if memory:
        getattr(problem, "problem", problem).recall(memory)


@dataclass
class OptimiserResult:
    """The best point found and how the search went."""

    x: Tensor
    cost: float
    reason: str  # "converged", "max_iterations", "no_descent" or "not_finite"
    iterations: int
    history: list[float] = field(default_factory=list)  # accepted costs
    memory: dict[str, Any] = field(default_factory=dict)  # of the problem, at the end


@dataclass
class _Search:
    """All that decides how the search goes on, beside the equations at x."""

    x: Tensor
    best: float
    damping: float
    scale: Tensor
    history: list[float]
    growth: float = 2.0
    quiet: int = 0
    iteration: int = 0

    def over(self, patience: int) -> str | None:
        """Why the search is over; None while it is not."""
        return "converged" if self.quiet >= patience else "no_descent" if self.damping > 1e12 else None

    def ends(self, predicted: float, enough: float) -> bool:
        """Whether an all but undamped step is to lower the cost by next to nothing beside what is `enough`."""
        return self.damping <= FREE and 0 <= predicted < LEFT * enough

    @classmethod
    def gone_on(cls, x: Tensor, cost: float, scale: Tensor, damping: float, resumed: Any) -> _Search:
        """The search at its start x, or where it was interrupted."""
        if resumed is None:
            return cls(x, cost, damping, scale.clone(), [cost])
        return cls(**{**resumed["search"], "x": x, "scale": resumed["search"]["scale"].to(x)})


def levenberg_marquardt(
    problem: SumOfSquares,
    x: Tensor,  # (P,) start
    *,
    max_iterations: int = 150,  # accepted and rejected steps together
    rtol: float = 1e-6,
    atol: float = 0.0,
    patience: int = 5,
    damping: float = 1e-3,  # λ of the first step; far smaller where few combinations of the unknowns are free
    callback: Progress | None = None,  # called after each iteration; a search goes on from what it holds, bit for bit
) -> OptimiserResult:
    """Minimise ½|r(x)|².

    Each iteration solves (JᵀJ + λ D) δ = −Jᵀr with D the running maximum of diag JᵀJ (Marquardt's scaling, Moré's
    monotone version) by Cholesky, or by conjugate gradients where JᵀJ is known by its products; λ follows the ratio of
    actual to predicted decrease (Nielsen's rule).

    The search ends after `patience` accepted steps in a row that each lower the cost by less than `atol`, or `rtol`
    relative. A step that changes it by rounding only is not taken and counts as one of them. It ends at once where an
    all but undamped step is to lower the cost by less than a hundredth of that. The result is always the best finite
    point.
    """
    resumed = None if callback is None else callback.resumed
    if resumed is not None:
        remind(problem, resumed["memory"])
        x = resumed["search"]["x"].to(x)
    cost, A, b = _of_first(problem.normal_equations(x))
    if not bool(torch.isfinite(cost)):
        return OptimiserResult(x, float(cost), "not_finite", 0)
    at = _Search.gone_on(x, float(cost), A.diagonal(), damping, resumed)
    rounding = max(ROUNDING, 8 * torch.finfo(cost.dtype).eps)
    while at.iteration < max_iterations and at.over(patience) is None:
        at.iteration += 1
        beat()
        step = _damped_step(A, b, at.damping * _floored(at.scale))
        new, predicted = math.inf, 0.0
        if step is not None:
            predicted = float(-(b @ step) - 0.5 * step @ (A @ step))
            if at.ends(predicted, max(rtol * at.best, atol)):
                at.quiet = patience
                break
            new = float(of_first(problem.cost(at.x + step))[0])
        # Whether rounding lets the cost fall differs from machine to machine; the search must not depend on it.
        settled = abs(at.best - new) <= rounding * at.best
        if step is not None and not settled and new < at.best and predicted > 0:
            gain = (at.best - new) / predicted
            at.quiet = at.quiet + 1 if at.best - new <= max(rtol * at.best, atol) else 0
            at.x = at.x + step
            cost, A, b = _of_first(problem.normal_equations(at.x))
            at.best = float(cost)
            at.history.append(at.best)
            at.scale = torch.maximum(at.scale, A.diagonal())
            at.damping *= max(1 / 3, 1 - (2 * gain - 1) ** 3)
            at.damping, at.growth = max(at.damping, 1e-14), 2.0
        else:
            at.quiet += settled
            at.damping, at.growth = at.damping * at.growth, at.growth * 2
        if callback is not None:
            callback(at.iteration, at.best, at.x, lambda: {"search": asdict(at), "memory": memory_of(problem)})
    reason = at.over(patience) or "max_iterations"
    return OptimiserResult(at.x, at.best, reason, at.iteration, at.history, memory_of(problem))


def _floored(scale: Tensor) -> Tensor:
    """Keep the scaling positive where a parameter has had no influence yet (behind a zero-initialised layer).

    Those that have some keep their own, however small: it is a power of the unit of length.
    """
    largest = float(scale.max())
    return torch.where(scale > 0, scale, largest if largest > 0 else 1.0)


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
