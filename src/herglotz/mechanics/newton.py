"""Newton's iteration with backtracking, batched: the only such loop, for every equation of this package.

Samples do not influence each other: every sample has its own Jacobian, its own fraction of a step and its own end. A
single sample may take the same loop with Python's floats in place of tensors (...): small tensors cost the most there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

Jacobian = Any  # a matrix (..., m, m), or a tuple of tensors (..., *) for the solver of the rules
Solver = Callable[[Jacobian, Tensor], Tensor]  # (J, F) → J⁻¹F, not finite where J is singular


class Point(NamedTuple):
    """An equation at a trial."""

    F: Tensor  # (..., m)
    J: Jacobian  # ∂F/∂x; None if the iteration did not ask for ∂F/∂x
    rest: Any = None  # further results of the equation, returned at the solution


class Equation(Protocol):
    """An equation F(x) = 0."""

    def __call__(self, x: Tensor, second: bool, /) -> Point:
        """F at x (..., m), and J if `second`."""
        ...


# Batches of larger matrices are solved one by one: torch 2.13 hands each to a thread of its own, where the LU
# decomposition of oneMKL, from 190 rows on, never ends or says that a parameter of its own was wrong.
AT_ONCE = 128
Number = Any  # (...) a number for each sample; a float for a sample that is `alone`
# The size of the unknown and the size below which a move is rounding, from x, the first point and |J⁻¹F|.
Sizes = Callable[[Tensor, Point, Number], tuple[Number, Number]]


def largest(x: Tensor) -> Tensor:
    """The largest component, (..., m) → (...)."""
    if x.shape[-1] == 1:
        return x[..., 0].abs()
    return x.abs().amax(-1) if x.shape[-1] else x.sum(-1)


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """matrix⁻¹ vector without an exception: inf or nan where the matrix is singular; written out for n ≤ 2."""
    n = matrix.shape[-1]
    if n == 1:
        return vector / matrix[..., 0]
    if n == 2:
        return _eliminate(matrix, vector)
    return solve_columns(matrix, vector[..., None])[..., 0]


def solve_columns(matrix: Tensor, columns: Tensor) -> Tensor:
    """matrix⁻¹ columns, (..., n, k), likewise."""
    n = matrix.shape[-1]
    if n == 1:
        return columns / matrix
    if n <= AT_ONCE or matrix.ndim == 2 or matrix.device.type != "cpu" or torch.get_num_threads() == 1:
        return torch.linalg.solve_ex(matrix, columns)[0]
    every = torch.broadcast_shapes(matrix.shape[:-2], columns.shape[:-2])
    pairs = zip(*(x.expand(*every, *x.shape[-2:]).flatten(0, -3) for x in (matrix, columns)), strict=True)
    return torch.stack([torch.linalg.solve_ex(a, b)[0] for a, b in pairs]).unflatten(0, every)


def _eliminate(matrix: Tensor, vector: Tensor) -> Tensor:
    """Gauss with a row exchange, for n = 2."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = vector.unbind(-1)
    swap = c.abs() > a.abs()
    a, c = torch.where(swap, c, a), torch.where(swap, a, c)
    b, d = torch.where(swap, d, b), torch.where(swap, b, d)
    x, y = torch.where(swap, y, x), torch.where(swap, x, y)
    factor = c / a
    y = (y - factor * x) / (d - factor * b)
    return torch.stack([(x - b * y) / a, y], -1)


def attached(x: Tensor, J: Tensor, F: Tensor) -> Tensor:
    """A solved x with its derivative: a Newton step of value 0 and slope dx = −J⁻¹ dF; F has the graph."""
    return x - solve(J, F - F.detach())


@dataclass(frozen=True)
class Rules:
    """The rules of an iteration.

    A move is accepted if |F| falls or, with `natural`, if the simplified Newton step J(x)⁻¹F(x + λδ) is shorter than δ,
    a test that does not depend on the units of F. Any other move is halved.
    """

    tol: float  # a sample has converged when its next move is below this times its size
    max_iterations: int
    keep: bool = False  # near the solution an old Jacobian serves, and costs first derivatives only
    natural: bool = False
    shortest: float = 0.0  # a direction of which no larger fraction helps is none, and its sample is given up
    solver: Solver | None = None  # default `solve`
    length: Callable[[Tensor], Tensor] = largest  # of a move


# Share of the size of x: a move below this converges fast enough with the Jacobian of the last iteration.
NEAR = 1e-3
CONTRACTION = 0.05  # an old Jacobian that gains less than this per iteration is replaced
ARMIJO = 1e-4  # |F| must fall by this share of what a linear equation would lose
NATURAL = 0.25  # the simplified Newton step by this share


class Found(NamedTuple):
    """Where an iteration ended."""

    x: Tensor  # (..., m)
    point: Point  # the equation at x, unless `mixed`
    merit: Tensor  # (...) |F|
    residual: Tensor  # (...) |J⁻¹F|
    done: Tensor  # (...) converged, stalled at rounding or given up; without, the iterations ran out
    iterations: int
    healthy: bool  # True for a single sample that is done with finite numbers; False if that is not known
    floor: Tensor | float = 0.0  # (...) see `Sizes`
    J: Jacobian = None  # at x, or an older Jacobian that still serves
    move: Tensor | None = None  # (..., m) −J⁻¹F, which was not taken any more
    mixed: bool = False  # the samples' last trials differ, so that `point` belongs to no trial


class _Here(NamedTuple):
    """Where the samples are, and Newton's step from there."""

    x: Tensor  # (..., m)
    point: Point
    J: Jacobian
    delta: Tensor | float  # (..., m) −J⁻¹F
    merit: Number  # |F|
    residual: Number  # |J⁻¹F|


def _moved(here: _Here, trial: _Here, accept: Number, refused: bool, alone: bool) -> tuple[_Here, bool]:
    """The accepted trial of each sample, and whether samples accepted different trials."""
    if not refused:  # a done sample's trial is its own x: nothing to select
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
    tiny, near = rules.tol * scale, NEAR * scale
    # A direction that is not finite can never be followed: the sample ends, and costs its neighbours nothing.
    going = (here.residual > tiny) & (here.residual < inf)
    fraction: Number = None  # every sample takes full steps
    slow: Number = False  # samples whose old Jacobian no longer serves
    stale: Number = False  # samples whose last move used an old Jacobian
    back: Number = False  # samples that a stale move misled: these take no step, but a new Jacobian at x
    mixed, iterations = False, 0
    while iterations < rules.max_iterations and _any(going):
        if not rules.natural or _any(here.residual > floor):  # the last digits are not counted
            iterations += 1
        move = here.delta if fraction is None else (fraction if alone else fraction[..., None]) * here.delta
        # At a trial that may be far off, the Jacobian is wanted as well.
        fresh = going & (here.residual > near) | slow | back if rules.keep else True
        move = move if alone else torch.where(going[..., None], move, 0.0)
        trial = _evaluate(equation, here.x + move, rules, alone, here.J, fresh)
        settled = trial.residual <= tiny
        better = _falls(rules, here, trial, 1.0 if fraction is None else fraction) | settled
        stalled = _not(better) & (here.residual <= floor)  # rounding, not a wrong direction
        if rules.keep:
            still = _not(fresh | settled) & going & (trial.residual < inf)
            slow = still & (trial.residual > CONTRACTION * here.residual)
            better = better | (slow & _not(stalled) & (trial.merit <= here.merit))
        accept = better & going
        refused = going & _not(better)
        going = going & _not(settled | stalled)
        if rules.natural:  # this test may accept a trial where J is singular
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
    """The equation at x; if the rules keep Jacobians, samples that are not `fresh` have J."""
    second = not rules.keep or _any(fresh)
    point = equation(x, second)
    if second:
        J = select(fresh, point.J, J) if rules.keep and isinstance(fresh, Tensor) else point.J
    if alone:
        return _Here(x, point, J, *newton_step(J, point.F))
    delta = -(rules.solver or solve)(J, point.F)
    return _Here(x, point, J, delta, largest(point.F), rules.length(delta))


def _next(fraction: Number, accept: Number, natural: bool, like: Number) -> Number:
    """The fractions of the next move: half after a refused trial, 1 or twice the fraction after an accepted trial."""
    if isinstance(accept, bool):
        return 1.0 if accept else (fraction or 1.0) / 2
    fraction = torch.ones_like(like) if fraction is None else fraction
    return torch.where(accept, (2 * fraction).clamp(max=1.0) if natural else 1.0, fraction / 2)


def _falls(rules: Rules, here: _Here, trial: _Here, fraction: Number) -> Number:
    """In which samples a trial passes the test of descent."""
    if rules.natural:
        solver = rules.solver or solve
        return rules.length(solver(here.J, trial.point.F)) <= (1 - NATURAL * fraction) * here.residual
    return trial.merit <= (1 - ARMIJO * fraction) * here.merit


def _any(mask: Number) -> bool:
    return mask if isinstance(mask, bool) else bool(mask.any())


def _not(mask: Number) -> Number:
    return not mask if isinstance(mask, bool) else ~mask


def _found_alone(here: _Here, done: bool, iterations: int) -> Found:
    """The end of a sample that was iterated alone, its floats as tensors."""
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
    """−(a b; c d)⁻¹ (x, y), Gauss with a row exchange."""
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
    """The largest absolute value, NaN if any entry is NaN."""
    return nan if any(v != v for v in values) else max(map(abs, values), default=0.0)


def select(mask: Tensor, a: Any, b: Any) -> Any:
    """The tensor a, or each of a tuple, in the samples of the mask (...), b in the others."""
    if isinstance(a, tuple):
        return tuple(select(mask, *pair) for pair in zip(a, b, strict=True))
    return torch.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)


# Ends an iteration that neither converges nor fails.
MAX_ITERATIONS = 50
SHORTEST = 1e-6  # twenty halvings: no direction of descent


@dataclass(frozen=True)
class Root:
    """The solution of an equation, sample by sample."""

    x: Tensor  # (..., m)
    converged: Tensor  # (...) bool
    error: Tensor  # (...) last |J⁻¹F| in units of the scale; inf or nan where J is singular
    iterations: int
    J: Jacobian  # at x
    move: Tensor  # (..., m) the next move, −J⁻¹F: x + move is exact to the square of the error

    @property
    def solved(self) -> Tensor:
        """(..., m) x, NaN in the samples that did not converge."""
        return torch.where(self.converged[..., None], self.x, torch.nan)

    def with_slope(self, F: Callable[[Tensor], Tensor]) -> Tensor:
        """(..., m) x with its derivative where gradients are on; F(x), 0 at the solution, has the graph."""
        return attached(self.x, self.J, F(self.x)) if torch.is_grad_enabled() else self.x


def find_root(
    equations: Callable[[Tensor], tuple[Tensor, Jacobian]],  # x (..., m) → F (..., m) and its Jacobian
    guess: Tensor,  # (..., m)
    scale: Tensor | None = None,  # (..., m) size of every unknown; default that of the largest at the start
    solver: Solver | None = None,
    iterations: int = MAX_ITERATIONS,
    tol: float | None = None,  # default rounding
) -> Root:
    """Solve F(x) = 0 from `guess`, without a graph, to rounding; the test of a move is the natural one.

    A sample has converged when its residual is rounding, or when a move below eps^(2/3) of `scale` lowers the residual
    no further. A sample that is singular, not finite or makes no progress is given up.
    """
    eps = torch.finfo(guess.dtype).eps
    tol = 4 * eps if tol is None else tol
    enough = max(eps ** (2 / 3), tol)
    unit = None if scale is None else torch.where(scale > 0, scale, 1.0)

    def sizes(x: Tensor, _: Point, left: Tensor) -> tuple[Tensor, Tensor]:
        size = torch.ones_like(left)  # moves are measured in the scale
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
