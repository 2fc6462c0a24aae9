"""The derivative of one step Φ̃ in closed form, by the implicit-function theorem."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.mechanics.legendre import momentum_jacobian
from herglotz.mechanics.linear import solve_columns
from herglotz.mechanics.partials import Partials


def step_derivative(
    P: Partials,  # (q0, q1, s0) of a solved step, order 2
    p0: Tensor,  # (..., n)
) -> Tensor:
    """DΦ̃ at (q0, p0, s0), shape (..., 2n+1, 2n+1), ordered q, p, s.

    From F(q0, q1, p0, s0) = D1 + c p0 = 0:

        dq1 = −J⁻¹ (F_q0 dq0 + c dp0 + F_s ds0),    J = D1D2 + p0 ⊗ D2D3
        dp1 = D2D1 dq0 + D2D2 dq1 + D2D3 ds0
        ds1 = D1·dq0 + D2·dq1 + c ds0

    With forces ∂F⁻ joins F_q0, J and F_s, and ∂F⁺ the three coefficients of dp1.
    """
    n = p0.shape[-1]
    eye = torch.eye(n, dtype=p0.dtype, device=p0.device)
    F_q0 = P.D11 + p0[..., :, None] * P.D13[..., None, :]
    F_p0 = P.c[..., None, None] * eye
    F_s0 = (P.D13 + p0 * P.D33[..., None])[..., None]
    p1_q0, p1_q1, p1_s0 = P.D12.mT, P.D22, P.D23[..., None]
    if P.force is not None:
        F_q0, F_s0 = F_q0 + P.force.minus_1, F_s0 + P.force.minus_3[..., None]
        p1_q0, p1_q1, p1_s0 = p1_q0 + P.force.plus_1, p1_q1 + P.force.plus_2, p1_s0 + P.force.plus_3[..., None]
    J = momentum_jacobian(P, p0)
    # A coordinate that dry friction holds obeys Δ = q1 − q0 = 0 in place of F = 0.
    if P.force is not None and P.force.held is not None:
        rows = (P.force.held > 0)[..., None]
        F_q0, F_p0, F_s0 = torch.where(rows, -J, F_q0), torch.where(rows, 0.0, F_p0), torch.where(rows, 0.0, F_s0)
    dq1 = -solve_columns(J, torch.cat([F_q0, F_p0, F_s0], -1))
    zero = torch.zeros_like(F_p0)
    dp1 = p1_q1 @ dq1 + torch.cat([p1_q0, zero, p1_s0], -1)
    ds1 = (P.D2[..., None, :] @ dq1)[..., 0, :] + torch.cat([P.D1, zero[..., 0], P.c[..., None]], -1)
    return torch.cat([dq1, dp1, ds1[..., None, :]], -2)
