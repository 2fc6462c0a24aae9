"""Batched Newton with backtracking on the step equation D1 L_d(q0, q1, s0) + c p0 = 0, with a status per sample."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import isfinite
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian, Partials
from herglotz.stepping.equation import End, Equation, PartialsEquation
from herglotz.stepping.newton_one import CLOSE, CONTRACTION, Found, find_one


class Status(IntEnum):
    """How the solve for one step ended."""

    CONVERGED = 0
    MAX_ITERATIONS = 1  # no convergence within the allowed iterations
    SINGULAR = 2  # det J = 0 (or c = 0): the step is not defined there, erratum E4
    DIVERGED = 3  # a value stopped being finite
    STOPPED = 4  # no failure: a terminal event ended the trajectory in or before this step
    BAD_INPUT = 5  # h is no step, or a number is not finite: of exported files only, a stepper raises
    UNRESOLVED = 6  # solved, but h does not see the motion: set by `tune.flag_unresolved`, never by a stepper


@runtime_checkable
class Increments(Protocol):
    """A closed form that takes Δ = q1 − q0 in place of q1, so that nothing cancels when the step is small."""

    def partials_increment(self, q0: Tensor, delta: Tensor, s0: Tensor, h: Tensor, order: int = 1) -> Partials:
        """`partials` at (q0, q0 + Δ, s0)."""
        ...


@dataclass(frozen=True)
class Solution:
    """The solved step; `P` is evaluated at q1, so nothing has to be computed again."""

    q1: Tensor  # (..., n)
    P: Partials  # of order 2 unless `order=1` was asked for
    status: Tensor  # (...) Status values, uint8
    residual: Tensor  # (...) |J⁻¹F|, the error left in q1, in units of q
    iterations: int
    increment: Tensor | None = None  # (..., n) Δ = q1 − q0 before rounding, where it was the unknown


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """matrix⁻¹ vector without an exception: inf or nan where the matrix is singular; written out for n ≤ 2."""
    n = matrix.shape[-1]
    if n == 1:
        return vector / matrix[..., 0]
    if n == 2:
        return _eliminate(matrix, vector)
    return torch.linalg.solve_ex(matrix, vector[..., None])[0][..., 0]


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


def solve_step(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    p0: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor,  # () or (...)
    guess: Tensor,  # (..., n) where the iteration starts
    tol: float,
    max_iterations: int = 30,
    order: int = 2,
    increments: bool = False,
) -> Solution:
    """Solve F(q1) = D1 L_d(q0, q1, s0) + c p0 = 0 for q1 (FL⁻ inverted; never through H⁺, erratum E4).

    A sample has converged when its next Newton step is below `tol` times the size of its positions. Samples do not
    influence one another: each has its own Jacobian, its own step length and its own status.

    Parameters
    ----------
    order
        Derivatives of L_d in the result. With 1, an iteration that starts close to the solution keeps its Jacobian
        and costs first derivatives only; the answer is the same to `tol`.
    increments
        Take Δ = q1 − q0 for the unknown, for an L_d with `partials_increment`: no cancellation at small h.
        Convergence is then relative to the size of Δ.
    """
    assert not increments or isinstance(L_d, Increments)
    equation = PartialsEquation(L_d, q0, p0, s0, h, order, increments)
    found = find_root(equation, q0, guess, tol, max_iterations, order, increments)
    P = found.point.rest
    status, _ = status_of(found, End(P.D2, P.L, P.c))
    if increments:
        return Solution(q0 + found.x, P, status, found.residual, found.iterations, found.x)
    return Solution(found.x, P, status, found.residual, found.iterations)


def find_root(
    equation: Equation, q0: Tensor, guess: Tensor, tol: float, max_iterations: int, order: int, increments: bool
) -> Found:
    """The iteration of `solve_step` for an equation; with `order` 2 every Jacobian is fresh, the last one too."""
    x = guess - q0 if increments else guess
    if x.shape[:-1].numel() == 1:
        return find_one(equation, q0, x, tol, max_iterations, order, increments)
    point = equation(x, True)
    assert point.J is not None
    J = point.J
    delta, merit = _direction(J, point.F)
    residual = _length(delta)
    size = _length(x) + _length(solve(J, equation.push(point))) if increments else _length(q0)
    scale = torch.maximum(size, torch.maximum(_length(x), residual))
    limits = torch.finfo(scale.dtype)  # the floor: tolerances of denormal size would keep a motion from coming to rest
    scale = torch.nan_to_num(scale, nan=1.0, posinf=1.0).clamp(min=limits.tiny / limits.eps)
    tiny, near = tol * scale, CLOSE * scale
    floor = 1e3 * limits.eps * torch.maximum(scale, equation.typical_increment())
    # A direction that is not finite can never be followed: such a sample is over, and costs its neighbours nothing.
    done = (residual <= tiny) | ~torch.isfinite(residual)
    length: Tensor | None = None  # None: every sample takes full steps
    slow: Tensor | None = None  # samples whose old Jacobian has served its time
    mixed, iterations = False, 0
    while iterations < max_iterations and not bool(done.all()):
        iterations += 1
        move = delta if length is None else length[..., None] * delta
        trial = x + torch.where(done[..., None], 0.0, move)
        fresh = ~done & (residual > near)  # at a trial that may be far off, the Jacobian is wanted as well
        fresh = fresh if slow is None else fresh | slow
        second = order == 2 or bool(fresh.any())
        point_trial, J_trial = equation(trial, second), J
        if second:
            assert point_trial.J is not None
            J_trial = _where(fresh, point_trial.J, J) if order == 1 else point_trial.J
        delta_trial, merit_trial = _direction(J_trial, point_trial.F)
        left = _length(delta_trial)
        settled = left <= tiny
        gain = (1 - 1e-4) if length is None else 1 - 1e-4 * length
        better = (merit_trial <= gain * merit) | settled
        stalled = ~better & (residual <= floor)  # rounding, not a wrong direction
        slow = None
        if order == 1:
            slow = ~fresh & ~done & ~settled & (left > CONTRACTION * residual) & torch.isfinite(left)
            better = better | (slow & ~stalled)
        accept = better & ~done
        done_next = done | settled | stalled
        if bool((better | done).all()):  # a done sample's trial is its own x: nothing to select
            x, J, delta, merit, residual = trial, J_trial, delta_trial, merit_trial, left
            point, mixed = point_trial, False
            length = None if length is None else torch.ones_like(merit)
        else:
            x, J, delta = (_where(accept, new, old) for new, old in ((trial, x), (J_trial, J), (delta_trial, delta)))
            merit, residual = torch.where(accept, merit_trial, merit), torch.where(accept, left, residual)
            mixed = True  # the points of the samples are from different trials
            length = torch.where(accept, 1.0, (torch.ones_like(merit) if length is None else length) / 2)
        done = done_next
    point = equation(x, order == 2) if mixed else point
    return Found(x, point, merit, residual, done, iterations, healthy=False)


def status_of(found: Found, end: End) -> tuple[Tensor, bool]:
    """The status of each sample, and whether all of them have converged."""
    merit, residual, done, L, c = found.merit, found.residual, found.done, end.L, end.c
    if found.healthy:
        good = isfinite(L.item()) and c.item() != 0
    else:
        good = bool((done & torch.isfinite(residual + merit + L) & (c != 0)).all())
    if good:
        return torch.zeros_like(merit, dtype=torch.uint8), True
    finite = torch.isfinite(merit) & torch.isfinite(L)
    status = torch.full_like(merit, Status.MAX_ITERATIONS, dtype=torch.uint8)
    status = torch.where(done, Status.CONVERGED, status)
    status = torch.where(~torch.isfinite(residual) | (c == 0), Status.SINGULAR, status)
    return torch.where(finite, status, Status.DIVERGED).to(torch.uint8), False


def _direction(J: Tensor, F: Tensor) -> tuple[Tensor, Tensor]:
    """−J⁻¹F and |F|."""
    return -solve(J, F), _length(F)


def _length(x: Tensor) -> Tensor:
    if x.shape[-1] == 1:
        return x[..., 0].abs()
    return x.abs().amax(-1) if x.shape[-1] else x.sum(-1)


def _where(mask: Tensor, a: Tensor, b: Tensor) -> Tensor:
    return torch.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)
