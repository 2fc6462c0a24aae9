"""Batched Newton with backtracking on the step equation D1 L_d(q0, q1, s0) + c p0 = 0, with a status per sample."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian, Partials, momentum_jacobian, momentum_residual, partials


class Status(IntEnum):
    """How the solve for one step ended."""

    CONVERGED = 0
    MAX_ITERATIONS = 1  # no convergence within the allowed iterations
    SINGULAR = 2  # det J = 0 (or c = 0): the step is not defined there, erratum E4
    DIVERGED = 3  # a value stopped being finite


@dataclass(frozen=True)
class Solution:
    """The solved step; `P` (order 2) is evaluated at q1, so nothing has to be computed again."""

    q1: Tensor  # (..., n)
    P: Partials
    status: Tensor  # (...) Status values, uint8
    residual: Tensor  # (...) |J⁻¹F|, the error left in q1, in units of q
    iterations: int


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """matrix⁻¹ vector without an exception: inf or nan where the matrix is singular; division for n = 1."""
    if matrix.shape[-1] == 1:
        return vector / matrix[..., 0]
    return torch.linalg.solve_ex(matrix, vector[..., None])[0][..., 0]


def solve_step(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    p0: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor,  # () or (...)
    guess: Tensor,  # (..., n) where the iteration starts
    tol: float,
    max_iterations: int = 30,
) -> Solution:
    """Solve F(q1) = D1 L_d(q0, q1, s0) + c p0 = 0 for q1 (FL⁻ inverted; never through H⁺, erratum E4).

    A sample has converged when its next Newton step is below `tol` times the size of its positions. Samples do not
    influence one another: each has its own step length and its own status.
    """
    q1, P = guess, partials(L_d, q0, guess, s0, h, order=2)
    delta, merit = _newton_direction(P, p0)
    scale = torch.maximum(q0.abs().amax(-1), torch.maximum(guess.abs().amax(-1), delta.abs().amax(-1)))
    scale = torch.nan_to_num(scale, nan=1.0, posinf=1.0)
    done = _length(delta) <= tol * scale
    length = torch.ones_like(merit)
    floor = 1e3 * torch.finfo(q0.dtype).eps
    iterations = 0
    while not bool(done.all()) and iterations < max_iterations:
        iterations += 1
        move = torch.where(done[..., None], 0.0, length[..., None] * delta)
        trial = q1 + move
        P_trial = partials(L_d, q0, trial, s0, h, order=2)
        delta_trial, merit_trial = _newton_direction(P_trial, p0)
        better = merit_trial <= (1 - 1e-4 * length) * merit
        settled = _length(delta_trial) <= tol * scale
        stalled = ~better & (_length(delta) <= floor * scale)  # rounding, not a wrong direction
        accept = ~done & (better | settled)
        q1 = _where(accept, trial, q1)
        P = P_trial.map(lambda new, old, accept=accept: _where(accept, new, old), P)
        delta, merit = _where(accept, delta_trial, delta), torch.where(accept, merit_trial, merit)
        length = torch.where(accept, 1.0, length / 2)
        done = done | settled | stalled
    residual = _length(delta)
    finite = torch.isfinite(merit) & torch.isfinite(P.L)
    status = torch.full_like(merit, Status.MAX_ITERATIONS, dtype=torch.uint8)
    status = torch.where(done, Status.CONVERGED, status)
    status = torch.where(~torch.isfinite(residual) | (P.c == 0), Status.SINGULAR, status)
    status = torch.where(finite, status, Status.DIVERGED)
    return Solution(q1, P, status.to(torch.uint8), residual, iterations)


def _newton_direction(P: Partials, p0: Tensor) -> tuple[Tensor, Tensor]:
    """−J⁻¹F and |F|."""
    F = momentum_residual(P, p0)
    return -solve(momentum_jacobian(P, p0), F), _length(F)


def _length(x: Tensor) -> Tensor:
    return x.abs().amax(-1) if x.shape[-1] else x.sum(-1)


def _where(mask: Tensor, a: Tensor, b: Tensor) -> Tensor:
    return torch.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)
