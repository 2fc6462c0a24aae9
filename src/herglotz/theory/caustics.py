"""Discrete Lagrangian dynamics: caustics, where the map from the parameter of a family of solutions to q_N is singular.

A family with S^k on Q is continued by S^{k+1}(y) = ext_x [S^k(x) + L_d(x, y, S^k(x))]. With p = dS^k(x),

    W_k = D11 + p ⊗ D13 + D13 ⊗ p + D33 p ⊗ p + c d²S^k,    d²S^{k+1} = D22 − Jᵀ W_k⁻¹ J,    J = D12 + p ⊗ D23.

The extremum is lost where the symmetric pivot W_k is singular, whether J is regular or not. A family has passed a
caustic inside step k where the number of negative eigenvalues of W_k differs from that of the kinetic term. The
eigenvalues of ∂q_{k+1}/∂q_k = −J⁻¹ W_k, J regular, decide nothing: with gyroscopic terms they may be complex.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import Partials, momentum_jacobian, step_derivative
from herglotz.mechanics.regularity import least_singular_value, left_hessian, scaled_margin


@dataclass(frozen=True)
class Opening:
    """How far a family of solutions with n parameters has spread after N steps.

    `final` is 0 at a caustic. It is the smallest singular value of Y_N = ∂q_N over the largest norm of any Y_k or,
    where a J is singular, the smallest margin of any W_k. `crossed` is the first step inside which the family passes a
    caustic, or −1. `slope` is ∂p_N/∂q_N = d²S^N.
    """

    final: Tensor  # (...)
    crossed: Tensor  # (...)
    slope: Tensor  # (..., n, n)


def opening(
    P: Partials,
    p: Tensor,  # (..., N, n)
    tangent: Tensor,  # (..., 2n+1, n)
) -> Opening:
    """Propagate the tangent vectors Y_k = ∂q_k and the pivots W_k of a family along its solution.

    P are the second-order partials of the N steps, with entries (..., N, *), p the momenta p_0 … p_{N−1}, and `tangent`
    the derivative of (q_0, p_0, s_0) by the parameter.

    If p_0 is the parameter, Y_0 = 0 and a caustic is a conjugate point. If q_0 is the parameter, with p_0 = dS(q_0),
    then Y_0 = 1 and a caustic is a point where W_k, the A + cα of the Riccati recursion, is singular.
    """
    n, point = p.shape[-1], not bool((tangent[..., : p.shape[-1], :] != 0).any())
    J, D = momentum_jacobian(P, p), step_derivative(P, p)
    A, kinetic = left_hessian(P, p), _negative_kinetic(J)
    regular = (scaled_margin(J, J, P.D11, P.D22) > 1e3 * torch.finfo(p.dtype).eps).all(-1)
    start = tangent[..., n : 2 * n, :]
    # A point source has S¹ = L_d.
    slope = P.D22[..., 0, :, :] if point else start
    Y, current, margins = [tangent[..., :n, :]], tangent, []
    crossed = first = torch.full_like(P.L[..., 0], -1, dtype=torch.long)
    for k in range(p.shape[-2]):
        current = D[..., k, :, :] @ current
        Y.append(current[..., :n, :])
        if k == 0 and point:
            continue
        bend = P.c[..., k, None, None] * slope
        W = A[..., k, :, :] + bend
        margins.append(scaled_margin(W, W, A[..., k, :, :], bend).nan_to_num(0.0))
        count = _negative(W)
        first = count if len(margins) == 1 else first
        # A singular J does not determine the kinetic term; the inertia of the first pivot stands in for it.
        passed = count != torch.where(regular, kinetic[..., k], first)
        crossed = torch.where(passed & (crossed < 0), k, crossed)
        slope = P.D22[..., k, :, :] - J[..., k, :, :].mT @ torch.linalg.solve_ex(W, J[..., k, :, :])[0]
    largest = torch.stack([torch.linalg.matrix_norm(y, ord="fro") for y in Y], -1).amax(-1)
    final = torch.nan_to_num(least_singular_value(Y[-1]) / largest, nan=0.0)
    carried = torch.linalg.solve_ex(current[..., :n, :].mT, current[..., n : 2 * n, :].mT)[0]
    slope = torch.where(regular[..., None, None], carried, slope)
    if margins:
        final = torch.where(regular, final, torch.stack(margins, -1).amin(-1))
    return Opening(final, crossed, 0.5 * (slope + slope.mT))


def _negative_kinetic(J: Tensor) -> Tensor:
    """Number of negative eigenvalues of the kinetic term m/h, found from −J = m/h.

    A strong magnetic field turns −J. Where the skew part of J exceeds its symmetric part, the latter says nothing about
    the mass, and a positive kinetic term is assumed: the number is 0.
    """
    symmetric, skew = 0.5 * (J + J.mT), 0.5 * (J - J.mT)
    turned = torch.linalg.matrix_norm(skew) > torch.linalg.matrix_norm(symmetric)
    return torch.where(turned, 0, _negative(-symmetric))


def _negative(W: Tensor) -> Tensor:
    """Number of negative eigenvalues of a symmetric matrix; −1 where W is not finite, as after a caustic at a node."""
    finite = torch.isfinite(W).all(-1).all(-1)
    W = torch.where(finite[..., None, None], 0.5 * (W + W.mT), 0.0)
    return torch.where(finite, (torch.linalg.eigvalsh(W) < 0).sum(-1), -1)
