"""Batched Newton with backtracking, for the equations that define L⁻, H⁺, H⁻ and discrete curves with fixed ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Jacobian = tuple[Tensor, ...]  # each (..., *), in any form that its solver understands
Equations = Callable[[Tensor], tuple[Tensor, Jacobian]]  # x (..., m) → F (..., m) and its Jacobian
Solver = Callable[[Jacobian, Tensor], Tensor]  # (J, F) → J⁻¹F, not finite where J is singular

MAX_ITERATIONS = 50
SHORTEST = 1e-6  # fraction of a Newton step; a direction that needs less is none


@dataclass(frozen=True)
class Root:
    """Where Newton's iteration ended, sample by sample."""

    x: Tensor  # (..., m)
    converged: Tensor  # (...) bool
    error: Tensor  # (...) last |J⁻¹F| in units of `scale`; inf or nan where J is singular
    iterations: int

    @property
    def solved(self) -> Tensor:
        """(..., m) x, NaN in the samples that did not converge."""
        return torch.where(self.converged[..., None], self.x, torch.nan)


def dense(jacobian: Jacobian, F: Tensor) -> Tensor:
    """J⁻¹F for one matrix (..., m, m): inf or nan, without an exception, where it is singular."""
    (J,) = jacobian
    if J.shape[-1] == 1:
        return F / J[..., 0]
    return torch.linalg.solve_ex(J, F[..., None])[0][..., 0]


def find_root(
    equations: Equations,
    guess: Tensor,  # (..., m)
    scale: Tensor | None = None,  # (..., m) size of every unknown; default that of the largest at the start
    solver: Solver = dense,
    iterations: int = MAX_ITERATIONS,
) -> Root:
    """Solve F(x) = 0 by Newton's method from `guess`, without a graph.

    A step is halved until the simplified Newton step J(x)⁻¹F(x + λδ) has become shorter (the natural monotonicity
    test, which does not depend on the units of F). A sample has converged when its step is below eps^(2/3) of
    `scale`; up to two further full steps then bring it to rounding. Samples do not influence one another;
    one that is singular, not finite or makes no progress is given up.
    """
    with torch.no_grad():
        x = guess.detach()
        F, J = equations(x)
        delta = -solver(J, F)
        if scale is None:
            scale = torch.maximum(x.abs(), torch.nan_to_num(delta.abs(), nan=0.0, posinf=0.0)).amax(-1, keepdim=True)
        scale = torch.where(scale > 0, scale, 1.0)
        small = torch.finfo(x.dtype).eps ** (2 / 3)

        def size(step: Tensor) -> Tensor:
            return (step / scale).abs().amax(-1)

        length = torch.ones_like(F[..., 0])
        done, stuck, taken = size(delta) <= small, ~torch.isfinite(size(delta)), 0
        while not bool((done | stuck).all()) and taken < iterations:
            taken += 1
            trial = torch.where((done | stuck)[..., None], x, x + length[..., None] * delta)
            F_trial, J_trial = equations(trial)
            better = size(solver(J, F_trial)) <= (1 - length / 4) * size(delta)
            accept = ~done & ~stuck & better
            x, J = _where(accept, trial, x), tuple(_where(accept, a, b) for a, b in zip(J_trial, J, strict=True))
            delta = _where(accept, -solver(J_trial, F_trial), delta)
            length = torch.where(accept, torch.clamp(2 * length, max=1.0), length / 2)
            done = done | (size(delta) <= small)
            stuck = stuck | ~torch.isfinite(size(delta)) | (length < SHORTEST)
        rounding = 4 * torch.finfo(x.dtype).eps
        for _ in range(2):
            if bool((size(delta)[done] <= rounding).all()):
                break
            x = torch.where(done[..., None], x + delta, x)
            F, J = equations(x)
            delta = torch.where(done[..., None], -solver(J, F), delta)
        error = size(delta)
        return Root(x, done & (error <= small), error, taken)


def _where(mask: Tensor, a: Tensor, b: Tensor) -> Tensor:
    return torch.where(mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim)), a, b)
