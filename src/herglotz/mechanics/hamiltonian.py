"""Right and left discrete Hamiltonians, by the discrete Legendre transform of L_d."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.mechanics.partials import DiscreteLagrangian, partials


def right_hamiltonian_on_flow(q1: Tensor, p1: Tensor, L: Tensor) -> Tensor:
    """H⁺ = p1·q1 − L_d for a step already solved; shape (...)."""
    return (p1 * q1).sum(-1) - L


def left_hamiltonian_on_flow(q0: Tensor, p0: Tensor, L: Tensor) -> Tensor:
    """H⁻ = −p0·q0 − L⁻, with L⁻ = s1 − s0 = L_d along the step (erratum E5); shape (...)."""
    return -(p0 * q0).sum(-1) - L


def solve_right_position(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    p1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
    guess: Tensor,  # (..., n) near q1
    iterations: int = 20,
) -> Tensor:
    """Solve D2 L_d(q0, q1, s0) = p1 for q1 by Newton from `guess`; shape (..., n).

    This needs det D2D2 L_d ≠ 0, which is *not* what stepping needs (erratum E4): steps go through FL⁻.
    """
    q1 = guess
    for _ in range(iterations):
        P = partials(L_d, q0, q1, s0, h, order=2)
        dq = torch.linalg.solve_ex(P.D22, (p1 - P.D2)[..., None])[0][..., 0]
        q1 = q1 + dq
        if bool((dq.abs() <= 4 * torch.finfo(q0.dtype).eps * (1 + q1.abs())).all()):
            break
    return q1


def right_hamiltonian(
    L_d: DiscreteLagrangian, q0: Tensor, p1: Tensor, s0: Tensor, h: Tensor | float, guess: Tensor
) -> Tensor:
    """H⁺(q0, p1, s0) = p1·q1 − L_d(q0, q1, s0) where D2 L_d(q0, q1, s0) = p1; shape (...).

    Parameters
    ----------
    L_d
        The discrete Lagrangian.
    q0, p1
        (..., n) position and next momentum.
    s0
        (...) action variable.
    h
        Time step.
    guess
        (..., n) where Newton's iteration for q1 starts; H⁺ can have several branches and the guess picks one.

    Source: right discrete Hamiltonian of the paper.
    """
    q1 = solve_right_position(L_d, q0, p1, s0, h, guess)
    return right_hamiltonian_on_flow(q1, p1, L_d(q0, q1, s0, torch.as_tensor(h, dtype=q0.dtype, device=q0.device)))
