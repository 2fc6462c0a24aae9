"""Discrete Legendre transforms FL⁻, FL⁺ and the discrete Herglotz equation."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials


def momentum_minus(P: Partials) -> Tensor:
    """p_k = −(D1 L_d + F⁻) / c, the momentum of FL⁻ at (q_k, q_{k+1}, s_k); F⁻ = 0 without forces; shape (..., n)."""
    D1 = P.D1 if P.force is None else P.D1 + P.force.minus
    return -D1 / P.c[..., None]


def momentum_plus(P: Partials) -> Tensor:
    """p_{k+1} = D2 L_d + F⁺, the momentum of FL⁺ at (q_k, q_{k+1}, s_k); F⁺ = 0 without forces; shape (..., n)."""
    return P.D2 if P.force is None else P.D2 + P.force.plus


def legendre_minus(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """FL⁻(q0, q1, s0) = (q0, −D1 L_d / c, s0). Source: discrete Legendre transforms of the paper."""
    return q0, momentum_minus(partials(L_d, q0, q1, s0, h)), s0


def legendre_plus(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """FL⁺(q0, q1, s0) = (q1, D2 L_d, s0 + L_d), plus F⁺ where there are forces; s is taken at s0 (erratum E3)."""
    P = partials(L_d, q0, q1, s0, h)
    return q1, momentum_plus(P), s0 + P.L


def herglotz_residual(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n) q_{k−1}
    q1: Tensor,  # (..., n) q_k
    q2: Tensor,  # (..., n) q_{k+1}
    s0: Tensor,  # (...) s_{k−1}
    h0: Tensor | float,  # () or (...) t_k − t_{k−1}
    h1: Tensor | float,  # () or (...) t_{k+1} − t_k
) -> Tensor:
    """R_k = D1 L_d(q_k, q_{k+1}, s_k) + c_k D2 L_d(q_{k−1}, q_k, s_{k−1}), with s_k = s_{k−1} + L_d; (..., n).

    R_k has the unit of momentum and is zero along discrete trajectories.

    Source: discrete Herglotz equations; indices by erratum E3.
    """
    _, p, s1 = legendre_plus(L_d, q0, q1, s0, h0)
    P = partials(L_d, q1, q2, s1, h1)
    return momentum_residual(P, p)


def momentum_residual(P: Partials, p0: Tensor) -> Tensor:
    """F = D1 + c p0 (+ F⁻), the equation that a step solves for q1; shape (..., n).

    Where dry friction holds a coordinate, F⁻ is a set and F is the distance from this set: 0 if friction suffices.
    """
    F = unheld_residual(P, p0)
    held = None if P.force is None else P.force.held
    return F if held is None else torch.where(held > 0, soft_threshold(F, held), F)


def soft_threshold(x: Tensor, bound: Tensor) -> Tensor:
    """Soft thresholding x − clamp(x, −bound, bound): the part of x beyond ±bound. Value and slope are 0 between."""
    below = torch.where(x > bound, bound, x)
    return x - torch.where(-bound > below, -bound, below)


def momentum_jacobian(P: Partials, p0: Tensor) -> Tensor:
    """J = ∂F/∂q1 = D1D2 + p0 ⊗ D2D3 (+ ∂F⁻/∂q1), shape (..., n, n). Equal to M where F = 0. Needs order 2.

    A coordinate that dry friction holds obeys Δ = q1 − q0 = 0 instead; its row is e_i, scaled by J's diagonal.
    """
    J = unheld_jacobian(P, p0)
    held = None if P.force is None else P.force.held
    return J if held is None else torch.where((held > 0)[..., None], torch.diag_embed(J.diagonal(0, -2, -1)), J)


def unheld_residual(P: Partials, p0: Tensor) -> Tensor:
    """F without the impulse of dry friction on coordinates at rest; shape (..., n)."""
    F = P.D1 + P.c[..., None] * p0
    return F if P.force is None else F + P.force.minus


def unheld_jacobian(P: Partials, p0: Tensor) -> Tensor:
    """∂F/∂q1 of `unheld_residual`, (..., n, n)."""
    J = P.D12 + p0[..., :, None] * P.D23[..., None, :]
    return J if P.force is None else J + P.force.minus_2


def mixed_hessian(P: Partials) -> Tensor:
    """M = D1D2 − D1 ⊗ D3D2 / c, shape (..., n, n); with forces J at p0 = momentum_minus. Needs order 2.

    FL⁻ and FL⁺ are local diffeomorphisms exactly where c ≠ 0 and det M ≠ 0 (erratum E4).
    """
    return momentum_jacobian(P, momentum_minus(P))
