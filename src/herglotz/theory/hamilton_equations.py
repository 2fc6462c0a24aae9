"""Discrete Hamiltonian dynamics: the right and the left Hamilton equations, and steps by H⁺ or H⁻ alone.

`Stepper` inverts FL⁻, which exists under weaker conditions (erratum E4). The steps of this file serve comparisons, and
systems given by a discrete Hamiltonian. H is any callable H(a, b, s, h); `partials` differentiates H.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials

# Both are functions of two vectors, a scalar and h.
DiscreteHamiltonian = DiscreteLagrangian


def right_equations(
    P: Partials,
    p1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
) -> tuple[Tensor, Tensor, Tensor]:
    """q1 = D2H⁺, p0 = D1H⁺/(1 − D3H⁺), s1 = s0 + p1·D2H⁺ − H⁺, from the partials of H⁺ at (q0, p1, s0).

    Source: right discrete contact Hamilton equations of the paper.
    """
    return P.D2, P.D1 / (1 - P.D3)[..., None], s0 + (p1 * P.D2).sum(-1) - P.L


def left_equations(
    P: Partials,
    p0: Tensor,  # (..., n)
    s1: Tensor,  # (...)
) -> tuple[Tensor, Tensor, Tensor]:
    """q0 = −D1H⁻, p1 = −D2H⁻/(1 + D3H⁻), s0 = s1 + H⁻ − p0·D1H⁻, from the partials of H⁻ at (p0, q1, s1).

    Source: left discrete contact Hamilton equations of the paper, corrected by erratum E5.
    """
    return -P.D1, -P.D2 / (1 + P.D3)[..., None], s1 + P.L - (p0 * P.D1).sum(-1)


def right_step(
    H_plus: DiscreteHamiltonian,
    q0: Tensor,  # (..., n)
    p0: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """(q1, p1, s1) by the right equations: D1H⁺(q0, p1, s0) = (1 − D3H⁺) p0 is solved for p1.

    NaN where Newton's method finds no solution.
    """

    def equations(p1: Tensor) -> tuple[Tensor, Tensor]:
        P = partials(H_plus, q0, p1, s0, h, order=2)
        return P.D1 - (1 - P.D3)[..., None] * p0, P.D12 + p0[..., :, None] * P.D23[..., None, :]

    p1 = find_root(equations, p0).solved
    q1, _, s1 = right_equations(partials(H_plus, q0, p1, s0, h), p1, s0)
    return q1, p1, s1


def left_step(
    H_minus: DiscreteHamiltonian,
    q0: Tensor,  # (..., n)
    p0: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """(q1, p1, s1) by the left equations: the equations for q0 and s0 are solved for (q1, s1) together.

    NaN where Newton's method finds no solution.
    """
    n = q0.shape[-1]

    def equations(x: Tensor) -> tuple[Tensor, Tensor]:
        P = partials(H_minus, p0, x[..., :n], x[..., n], h, order=2)
        q, _, s = left_equations(P, p0, x[..., n])
        q_row = -torch.cat([P.D12, P.D13[..., None]], -1)
        s_q = P.D2 - (p0[..., None, :] @ P.D12)[..., 0, :]
        s_row = torch.cat([s_q, (1 + P.D3 - (p0 * P.D13).sum(-1))[..., None]], -1)
        return torch.cat([q - q0, (s - s0)[..., None]], -1), torch.cat([q_row, s_row[..., None, :]], -2)

    start = torch.cat([q0, s0[..., None]], -1)
    # Positions and actions have different units, and so different scales.
    action = s0.abs() + (p0 * q0).sum(-1).abs()
    scale = torch.cat([q0.abs().amax(-1, keepdim=True).expand(q0.shape), action[..., None]], -1)
    x = find_root(equations, start, torch.maximum(scale, start.abs())).solved
    q1, s1 = x[..., :n], x[..., n]
    _, p1, _ = left_equations(partials(H_minus, p0, q1, s1, h), p0, s1)
    return q1, p1, s1
