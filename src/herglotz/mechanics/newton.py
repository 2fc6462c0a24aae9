"""Newton's iteration with backtracking, batched: the package's only Newton loop, and the linear equations of a step.

Samples do not influence each other: every sample has its own Jacobian, its own fraction of a step and its own end. A
single sample may take the same loop with Python floats in place of tensors (...), which are slow for one number. A
linear equation with a singular matrix gives inf or nan in its own sample, and raises nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

# Batches of larger matrices are solved one by one: torch 2.13 gives each matrix a thread of its own, in which the LU
# decomposition of oneMKL hangs or fails from 190 rows on.
MAX_BATCHED_ROWS = 128


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """matrix⁻¹ vector without an exception: inf or nan where the matrix is singular; written out for n ≤ 2."""
    n = matrix.shape[-1]
    if n == 1:
        return vector / matrix[..., 0]
    if n == 2:
        return _eliminate(matrix, vector)
    return solve_columns(matrix, vector[..., None])[..., 0]


def solve_columns(matrix: Tensor, columns: Tensor) -> Tensor:
    """matrix⁻¹ columns, (..., n, k), without an exception."""
    n = matrix.shape[-1]
    if n == 1:
        return columns / matrix
    if n <= MAX_BATCHED_ROWS or matrix.ndim == 2 or matrix.device.type != "cpu" or torch.get_num_threads() == 1:
        return torch.linalg.solve_ex(matrix, columns)[0]
    batch = torch.broadcast_shapes(matrix.shape[:-2], columns.shape[:-2])
    pairs = zip(*(x.expand(*batch, *x.shape[-2:]).flatten(0, -3) for x in (matrix, columns)), strict=True)
    return torch.stack([torch.linalg.solve_ex(a, b)[0] for a, b in pairs]).unflatten(0, batch)


def _eliminate(matrix: Tensor, vector: Tensor) -> Tensor:
    """Gaussian elimination with a row exchange, for n = 2."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = vector.unbind(-1)
    swap = c.abs() > a.abs()
    a, c = torch.where(swap, c, a), torch.where(swap, a, c)
    b, d = torch.where(swap, d, b), torch.where(swap, b, d)
    x, y = torch.where(swap, y, x), torch.where(swap, x, y)
    factor = c / a
    y = (y - factor * x) / (d - factor * b)
    return torch.stack([(x - b * y) / a, y], -1)


# A matrix (..., m, m), or a tuple of tensors (..., *) that `Rules.solver` understands.
Jacobian = Any
Solver = Callable[[Jacobian, Tensor], Tensor]  # (J, F) → J⁻¹F, not finite where J is singular


class Point(NamedTuple):
    """An equation F(x) = 0 evaluated at a trial x.

    J is ∂F/∂x, or None if the iteration did not ask for it; `rest` is returned with the solution.
    """

    F: Tensor  # (..., m)
    J: Jacobian
    rest: Any = None


class Equation(Protocol):
    """An equation F(x) = 0."""

    def __call__(self, x: Tensor, second: bool, /) -> Point:
        """F at x (..., m), and J if `second`."""
        ...


Number = Any  # (...) or a float for a sample that is iterated `alone`
# (x, first point, |J⁻¹F|) → the size of the unknown and the size below which a move is rounding.
Sizes = Callable[[Tensor, Point, Number], tuple[Number, Number]]


def largest(x: Tensor) -> Tensor:
    """The largest absolute component, (..., m) → (...); 0 for m = 0."""
    if x.shape[-1] == 1:
        return x[..., 0].abs()
    return x.abs().amax(-1) if x.shape[-1] else x.sum(-1)


def attached(x: Tensor, J: Tensor, F: Tensor) -> Tensor:
    """The solved x with its derivative: a Newton step of value 0 and slope dx = −J⁻¹ dF; F carries the graph."""
    return x - solve(J, F - F.detach())


@dataclass(frozen=True)
class Rules:
    """The rules of an iteration.

    A move is accepted if |F| falls or, with `natural`, if the simplified Newton step J(x)⁻¹F(x + λδ) is shorter than δ:
    the natural test does not depend on the units of F. Any other move is halved.

    A sample has converged when its next move is shorter than `tol` times its size, and is given up when its fraction of
    a step falls below `shortest`. With `keep` a Jacobian of an earlier iteration serves near the solution, where trials
    then need first derivatives only. `solver` replaces `solve`, and `length` measures moves.
    """

    tol: float
    max_iterations: int
    keep: bool = False
    natural: bool = False
    shortest: float = 0.0
    solver: Solver | None = None
    length: Callable[[Tensor], Tensor] = largest


# Moves below this share of the size of x converge fast enough with the Jacobian of an earlier iteration.
MAX_MOVE_FOR_OLD_JACOBIAN = 1e-3
# An old Jacobian is replaced if a move leaves more than this share of the last move's length.
MAX_CONTRACTION_OF_OLD_JACOBIAN = 0.05
# Armijo's test: |F| must fall by this share of the decrease of a linear equation.
ARMIJO = 1e-4
# The natural test: the simplified Newton step must be shorter than δ by this share of the fraction λ.
NATURAL = 0.25


class Found(NamedTuple):
    """The end of an iteration.

    `point` is the equation at x, unless the samples accepted different trials (`mixed`). `healthy` is True for a single
    sample that is done with finite numbers, and False where nothing is known. J is the Jacobian at x, or an earlier
    one that still converges.
    """

    x: Tensor  # (..., m)
    point: Point
    merit: Tensor  # (...) |F|
    residual: Tensor  # (...) |J⁻¹F|
    done: Tensor  # (...) converged, stalled at rounding or given up; False: the iterations ran out
    iterations: int
    healthy: bool
    floor: Tensor | float = 0.0  # (...) the second of `Sizes`
    J: Jacobian = None
    move: Tensor | None = None  # (..., m) −J⁻¹F, the move that was not made
    mixed: bool = False


class _Here(NamedTuple):
    """The samples' places and Newton's step from there."""

    x: Tensor  # (..., m)
    point: Point
    J: Jacobian
    delta: Tensor | float  # (..., m) −J⁻¹F
    merit: Number  # (...) |F|
    residual: Number  # (...) |J⁻¹F|


def _moved(here: _Here, trial: _Here, accept: Number, refused: bool, alone: bool) -> tuple[_Here, bool]:
    """The accepted trial of each sample, and whether samples accepted different trials."""
    # The trial of a sample that is done is its own x, so nothing is selected where no trial is refused.
    if not refused:
        return trial, False
    if alone:
        return here, False
    values = (select(accept, new, old) for new, old in zip(trial[2:], here[2:], strict=True))
    return _Here(select(accept, trial.x, here.x), here.point, *values), True


def newton(equation: Equation, x: Tensor, rules: Rules, sizes: Sizes, alone: bool = False) -> Found:
    """Iterate from x (..., m), all samples at once.

    A single sample may be iterated `alone`, with floats for numbers, by rules without `natural` and without a solver.
    """
    here = _evaluate(equation, x, rules, alone)
    scale, floor = sizes(x, here.point, here.residual)
    tiny, near = rules.tol * scale, MAX_MOVE_FOR_OLD_JACOBIAN * scale
    # A sample whose direction is not finite ends at once, and costs its neighbours nothing.
    going = (here.residual > tiny) & (here.residual < inf)
    # While `fraction` is None every sample takes full steps.
    fraction: Number = None
    # Samples whose old Jacobian converges too slowly, samples whose last move used an old Jacobian, and samples that
    # such a move misled: the last make no move, but get a new Jacobian at x.
    slow: Number = False
    stale: Number = False
    back: Number = False
    mixed, iterations = False, 0
    while iterations < rules.max_iterations and _any(going):
        # With the natural test, iterations that only settle the last digits are not counted.
        if not rules.natural or _any(here.residual > floor):
            iterations += 1
        move = here.delta if fraction is None else (fraction if alone else fraction[..., None]) * here.delta
        # A trial that may be far from the solution needs a Jacobian of its own.
        fresh = going & (here.residual > near) | slow | back if rules.keep else True
        move = move if alone else torch.where(going[..., None], move, 0.0)
        trial = _evaluate(equation, here.x + move, rules, alone, here.J, fresh)
        settled = trial.residual <= tiny
        better = _falls(rules, here, trial, 1.0 if fraction is None else fraction) | settled
        # Below the floor a refused move means rounding, not a wrong direction.
        stalled = _not(better) & (here.residual <= floor)
        if rules.keep:
            still = _not(fresh | settled) & going & (trial.residual < inf)
            slow = still & (trial.residual > MAX_CONTRACTION_OF_OLD_JACOBIAN * here.residual)
            better = better | (slow & _not(stalled) & (trial.merit <= here.merit))
        accept = better & going
        refused = going & _not(better)
        going = going & _not(settled | stalled)
        # The natural test may accept a trial where J is singular.
        if rules.natural:
            going = going & _not(accept & _not(trial.residual < inf))
        here, mixed = _moved(here, trial, accept, _any(refused), alone)
        if fraction is not None or _any(refused):
            fraction = _next(fraction, accept, rules.natural, like=here.merit)
            going = going & (fraction >= rules.shortest)
            back = stale & refused
            fraction = fraction * _not(back)
        stale = accept & _not(fresh) | stale & _not(accept)
    if alone:
        return _found_alone(here, not going, iterations)
    x, point, J, delta, merit, residual = here
    assert isinstance(delta, Tensor)
    return Found(
        x, point, merit, residual, ~going, iterations, healthy=False, floor=floor, J=J, move=delta, mixed=mixed
    )


def _evaluate(
    equation: Equation, x: Tensor, rules: Rules, alone: bool, J: Jacobian = None, fresh: Number = True
) -> _Here:
    """The equation at x; if the rules keep Jacobians, samples that are not `fresh` keep J."""
    second = not rules.keep or _any(fresh)
    point = equation(x, second)
    if second:
        J = select(fresh, point.J, J) if rules.keep and isinstance(fresh, Tensor) else point.J
    if alone:
        return _Here(x, point, J, *newton_step(J, point.F))
    delta = -(rules.solver or solve)(J, point.F)
    return _Here(x, point, J, delta, largest(point.F), rules.length(delta))


def _next(fraction: Number, accept: Number, natural: bool, like: Number) -> Number:
    """The fractions of the next move: half after a refused trial, else 1 or, with `natural`, twice the fraction."""
    if isinstance(accept, bool):
        return 1.0 if accept else (fraction or 1.0) / 2
    fraction = torch.ones_like(like) if fraction is None else fraction
    return torch.where(accept, (2 * fraction).clamp(max=1.0) if natural else 1.0, fraction / 2)


def _falls(rules: Rules, here: _Here, trial: _Here, fraction: Number) -> Number:
    """(...) bool: the samples in which a trial passes the test of descent."""
    if rules.natural:
        solver = rules.solver or solve
        return rules.length(solver(here.J, trial.point.F)) <= (1 - NATURAL * fraction) * here.residual
    return trial.merit <= (1 - ARMIJO * fraction) * here.merit


def _any(mask: Number) -> bool:
    return mask if isinstance(mask, bool) else bool(mask.any())


def _not(mask: Number) -> Number:
    return not mask if isinstance(mask, bool) else ~mask


def _found_alone(here: _Here, done: bool, iterations: int) -> Found:
    """The end of a sample that was iterated alone, with tensors in place of floats."""
    shape, healthy = here.x.shape[:-1], done and isfinite(here.merit + here.residual)
    merit, residual = here.x.new_full(shape, here.merit), here.x.new_full(shape, here.residual)
    flag = torch.full(shape, done, device=here.x.device)
    return Found(here.x, here.point, merit, residual, flag, iterations, healthy)


def newton_step(J: Tensor, F: Tensor) -> tuple[Tensor | float, float, float]:
    """−J⁻¹F of a single sample, not finite if J is singular; |F|; and |J⁻¹F|."""
    n = F.shape[-1]
    if n == 1:
        f, j = F.item(), J.item()
        delta = -f / j if j else (-inf if f else nan)
        return delta, abs(f), abs(delta)
    f = F.flatten().tolist()
    if n == 2:
        delta = _eliminate_numbers(*J.flatten().tolist(), *f)
        return torch.tensor(delta, dtype=F.dtype, device=F.device).reshape(F.shape), norm(f), norm(delta)
    delta = -torch.linalg.solve_ex(J, F[..., None])[0][..., 0]
    return delta, norm(f), norm(delta.flatten().tolist())


def _eliminate_numbers(a: float, b: float, c: float, d: float, x: float, y: float) -> list[float]:
    """−(a b; c d)⁻¹ (x, y), Gaussian elimination with a row exchange."""
    if abs(c) > abs(a):
        a, b, c, d, x, y = c, d, a, b, y, x
    if not a:
        return [nan, nan]
    factor = c / a
    pivot = d - factor * b
    if not pivot:
        return [nan, nan]
    second = (y - factor * x) / pivot
    return [(b * second - x) / a, -second]


def norm(values: list[float]) -> float:
    """The largest absolute value; NaN if an entry is NaN."""
    return nan if any(v != v for v in values) else max(map(abs, values), default=0.0)


def select(mask: Tensor, a: Any, b: Any) -> Any:
    """The tensor a, or every tensor of a tuple a, in the samples of the mask (...), and b in the others."""
    if isinstance(a, tuple):
        return tuple(select(mask, *pair) for pair in zip(a, b, strict=True))
    return torch.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)


# Ends an iteration that neither converges nor fails.
MAX_ITERATIONS = 50
# Twenty halvings of a step without success: the direction is no direction of descent.
SHORTEST = 1e-6


@dataclass(frozen=True)
class Root:
    """The solution of an equation, sample by sample."""

    x: Tensor  # (..., m)
    converged: Tensor  # (...) bool
    error: Tensor  # (...) last |J⁻¹F| in units of the scale; inf or nan where J is singular
    iterations: int
    J: Jacobian  # (..., m, m) at x
    move: Tensor  # (..., m) the next move, −J⁻¹F: x + move is exact to the square of the error

    @property
    def solved(self) -> Tensor:
        """(..., m) x, with NaN in the samples that did not converge."""
        return torch.where(self.converged[..., None], self.x, torch.nan)

    def with_slope(self, F: Callable[[Tensor], Tensor]) -> Tensor:
        """(..., m) x with its derivative where gradients are on; F(x), 0 at the solution, carries the graph."""
        return attached(self.x, self.J, F(self.x)) if torch.is_grad_enabled() else self.x


def find_root(
    equations: Callable[[Tensor], tuple[Tensor, Jacobian]],  # (..., m) x → F (..., m) and its Jacobian
    guess: Tensor,  # (..., m)
    scale: Tensor | None = None,  # (..., m) size of every unknown; by default that of the largest at the start
    solver: Solver | None = None,
    iterations: int = MAX_ITERATIONS,
    tol: float | None = None,
) -> Root:
    """Solve F(x) = 0 from `guess` by the natural test, without a graph, to `tol` (by default to rounding).

    A sample has converged when its residual is rounding, or when a move below eps^(2/3) of `scale` lowers the residual
    no further. A sample that is singular, not finite or makes no progress is given up.
    """
    eps = torch.finfo(guess.dtype).eps
    tol = 4 * eps if tol is None else tol
    enough = max(eps ** (2 / 3), tol)
    unit = None if scale is None else torch.where(scale > 0, scale, 1.0)

    def sizes(x: Tensor, _: Point, left: Tensor) -> tuple[Tensor, Tensor]:
        # With a scale, moves are measured in its units.
        size = torch.ones_like(left)
        if unit is None:
            size = torch.maximum(largest(x), torch.nan_to_num(left, nan=0.0, posinf=0.0))
            size = torch.where(size > 0, size, 1.0)
        return size, enough * size

    length = largest if unit is None else lambda move: largest(move / unit)
    rules = Rules(tol, iterations, natural=True, shortest=SHORTEST, solver=solver, length=length)
    with torch.no_grad():
        found = newton(lambda x, _: Point(*equations(x)), guess.detach(), rules, sizes)
    error = found.residual * (enough / found.floor)
    assert found.move is not None
    return Root(found.x, found.done & (error <= enough), error, found.iterations, found.J, found.move)
