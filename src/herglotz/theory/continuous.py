"""Continuous dynamics of the paper: the fields of a contact Hamiltonian H(q, p, s), Herglotz's equations of L(q, v, s).

All functions are batched over leading dimensions. A result can be differentiated again where an argument wants a
gradient.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.scalar_fields import Hamiltonian, Lagrangian, derivatives


def contact_vector_field(
    H: Hamiltonian,
    q: Tensor,  # (..., n)
    p: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> tuple[Tensor, Tensor, Tensor]:
    """X_H: q̇ = H_p, ṗ = −(H_q + p H_s), ṡ = p·H_p − H.

    Source: contact Hamilton equations of the paper.
    """
    q_dot, p_dot, heat, H_value = _evolution(H, q, p, s)
    return q_dot, p_dot, heat - H_value


def evolution_vector_field(
    H: Hamiltonian,
    q: Tensor,  # (..., n)
    p: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> tuple[Tensor, Tensor, Tensor]:
    """E_H = X_H + H ∂_s: q̇ = H_p, ṗ = −(H_q + p H_s), ṡ = p·H_p. H is constant along E_H, and η(E_H) = 0.

    Source: erratum E2; Theorem 1 of the paper holds as printed for E_H.
    """
    return _evolution(H, q, p, s)[:3]


def herglotz_acceleration(
    L: Lagrangian,
    q: Tensor,  # (..., n)
    v: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> Tensor:
    """The acceleration a of Herglotz's equations, L_vv a = L_q + L_s L_v − L_vq v − L_vs L; with q̇ = v and ṡ = L.

    Raise InputError if L_vv is singular at a sample.  Source: d/dt L_v − L_q = L_s L_v, with d/dt expanded along ṡ = L.
    """
    P = derivatives(L, q, v, s, order=2)
    L_vq_v = (P.D12.mT @ v[..., None])[..., 0]
    force = P.D1 + P.D3[..., None] * P.D2 - L_vq_v - P.L[..., None] * P.D23
    a, info = torch.linalg.solve_ex(P.D22, force[..., None])
    if bool((info != 0).any()):
        sample = tuple(int(i) for i in (info != 0).nonzero()[0])
        raise InputError(f"L_vv is singular at sample {sample}: L gives no acceleration there; check its kinetic term")
    return a[..., 0]


def _evolution(H: Hamiltonian, q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The three components of E_H, and H."""
    P = derivatives(H, q, p, s)
    H_q, H_p, H_s = P.D1, P.D2, P.D3
    return H_p, -(H_q + p * H_s[..., None]), (p * H_p).sum(-1), P.L
