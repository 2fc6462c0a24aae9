"""Discrete Hamilton–Jacobi theory: functions S on Q that solve the equation, the projected flow and its diagram.

S is the paper's S_d^k = ŝ0 + S^k(q̂0, ·, ŝ0): the values of S are values of s.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics.contact import Flow, join
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials, value
from herglotz.theory.function_germ import Function, FunctionGerm, germ, prolongation


@dataclass(frozen=True)
class Quadratic:
    """S(q) = ½ q·αq + β·q + δ."""

    alpha: Tensor  # (..., n, n) symmetric
    beta: Tensor  # (..., n)
    delta: Tensor  # (...)

    def __call__(self, q: Tensor) -> Tensor:
        """S(q), shape (...)."""
        return self.germ(q).S

    def germ(self, q: Tensor) -> FunctionGerm:
        """Value and derivatives."""
        force = (self.alpha @ q[..., None])[..., 0]
        S = (0.5 * force * q + self.beta * q).sum(-1) + self.delta
        return FunctionGerm(S, force + self.beta, self.alpha.expand(*q.shape, q.shape[-1]))


@dataclass(frozen=True)
class PointSource:
    """S¹(y) = ŝ0 + L_d(q̂0, y, ŝ0) of all solutions through one point; S⁰ is not a function (erratum E7)."""

    L_d: DiscreteLagrangian
    q: Tensor  # (..., n) q̂0
    s: Tensor  # (...) ŝ0
    h: Tensor | float

    def __call__(self, y: Tensor) -> Tensor:
        """S¹(y), shape (...)."""
        return self.s + value(self.L_d, self.q, y, self.s, self.h)

    def germ(self, y: Tensor) -> FunctionGerm:
        """Value and derivatives."""
        q = self.q.expand(y.shape)
        P = partials(self.L_d, q, y, self.s.expand(y.shape[:-1]), self.h, order=2)
        return FunctionGerm(self.s + P.L, P.D2, P.D22)


def projected_flow(flow: Flow, S: Function, q: Tensor) -> Tensor:
    """Φ̃^γ(q_k): the position of Φ̃(γ^k(q_k)), shape (..., n)."""
    return flow(*prolongation(S, q))[0]


def projected_step(
    H_plus: DiscreteLagrangian, S0: Function, S1: Function, q0: Tensor, h: Tensor | float, guess: Tensor | None = None
) -> Tensor:
    """q_{k+1} = D2H⁺(q_k, dS^{k+1}(q_{k+1}), S^k(q_k)), solved for q_{k+1} by Newton's method; shape (..., n).

    NaN where there is no solution.  Source: projected discrete flow of the paper, with s = S^k(q_k).
    """
    s0 = germ(S0, q0).S
    eye = torch.eye(q0.shape[-1], dtype=q0.dtype, device=q0.device)

    def equations(q1: Tensor) -> tuple[Tensor, Tensor]:
        at = germ(S1, q1)
        P = partials(H_plus, q0, at.dS, s0, h, order=2)
        return q1 - P.D2, eye - P.D22 @ at.d2S

    return find_root(equations, q0 if guess is None else guess).solved


def commutation_defect(flow: Flow, S0: Function, S1: Function, q: Tensor) -> Tensor:
    """Φ̃(γ^k(q)) − γ^{k+1}(Φ̃^γ(q)), shape (..., 2n+1), for any map Φ̃ of T*Q × R; the first n components are zero.

    For the flow of an L_d, the defect is zero on an open set of q exactly if S solves the right and the left discrete
    Hamilton–Jacobi equation there; the right equation alone is not sufficient (erratum E10).

    Source: Theorem 3 of the paper; γ^{k+1} has dS^{k+1} (erratum E8).
    """
    q1, p1, s1 = flow(*prolongation(S0, q))
    return join(q1, p1, s1) - join(*prolongation(S1, q1))


def riccati_step(P: Partials, S: Quadratic) -> Quadratic:
    """S^{k+1} of a quadratic L_d = (c−1)s0 + ½q0·Aq0 + q0·Bq1 + ½q1·Cq1 and a quadratic S^k.

    α′ = C − Bᵀ(A + cα)⁻¹B,    β′ = −cBᵀ(A + cα)⁻¹β,    δ′ = cδ − ½c²β·(A + cα)⁻¹β

    P are the partials of L_d to second order at the origin, and S is S^k. The result is not finite at a caustic, where
    A + cα is singular.

    Source: section 3 of `docs/mathematics.md`.
    """
    c = P.c
    pivot = P.D11 + c[..., None, None] * S.alpha
    X = torch.linalg.solve_ex(pivot, torch.cat([P.D12, S.beta[..., None]], -1))[0]
    pivot_B, pivot_beta = X[..., :-1], X[..., -1]
    return Quadratic(
        P.D22 - P.D12.mT @ pivot_B,
        -c[..., None] * (P.D12.mT @ pivot_beta[..., None])[..., 0],
        c * S.delta - 0.5 * c**2 * (S.beta * pivot_beta).sum(-1),
    )
