"""Beyond the paper: contact Noether. The momentum of a symmetry of L_d shrinks as the contact form, J_{k+1} = c_k J_k.

A one-parameter group acts on Q by g(ε, q), with generator ξ(q) = ∂g/∂ε at ε = 0, and may shift the action variable,
s ↦ s + χ(ε, q) with χ(0, q) = 0. The lift of the group to T*Q × R keeps η. If

    L_d(g q0, g q1, s0 + χ(q0)) + χ(q0) − χ(q1) = L_d(q0, q1, s0)

then J = p·ξ(q) − χ′(q), χ′ = ∂χ/∂ε at ε = 0, satisfies J_{k+1} = c_k J_k along discrete motions. Proof: differentiate
the line above by ε and insert −D1 L_d = c p_k, D2 L_d = p_{k+1}. For the continuous motion {H, J} = 0, or J̇ = −H_s J.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.mechanics.contact import Triple, jacobian
from herglotz.mechanics.partials import DiscreteLagrangian, Hamiltonian, ScalarField, gradient, value
from herglotz.theory.contact_manifolds import jacobi_bracket

# g(ε, q): (...) and (..., n) → (..., n), with g(0, q) = q.
Action = Callable[[Tensor, Tensor], Tensor]
# χ(ε, q): (...) and (..., n) → (...), with χ(0, q) = 0.
Shift = Callable[[Tensor, Tensor], Tensor]


def infinitesimal_generator(action: Action, q: Tensor) -> Tensor:
    """ξ(q) = ∂g(ε, q)/∂ε at ε = 0, shape (..., n)."""
    return jacobian(lambda e: action(e[..., 0], q), torch.zeros_like(q[..., :1]))[1][..., 0]


def momentum_map(action: Action, shift: Shift | None = None) -> ScalarField:
    """The differentiable function J(q, p, s) = p·ξ(q) − χ′(q), in units of action per unit of ε."""

    def J(q: Tensor, p: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        def moved(e: Tensor) -> Tensor:
            value = (p * action(e[..., 0], q)).sum(-1)
            return value if shift is None else value - shift(e[..., 0], q)

        return gradient(moved, torch.zeros_like(q[..., :1]))[1][..., 0]

    return J


def invariance_defect(
    L_d: DiscreteLagrangian,
    action: Action,
    epsilon: Tensor | float,  # () or (...)
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
    shift: Shift | None = None,
) -> Tensor:
    """L_d(g q0, g q1, s0 + χ(q0)) + χ(q0) − χ(q1) − L_d(q0, q1, s0), shape (...): zero for a symmetry.

    The group parameter `epsilon` need not be small.
    """
    h = torch.as_tensor(h, dtype=q0.dtype, device=q0.device)
    e = torch.as_tensor(epsilon, dtype=q0.dtype, device=q0.device).expand(s0.shape)
    chi0, chi1 = (torch.zeros_like(s0) if shift is None else shift(e, q) for q in (q0, q1))
    moved = value(L_d, action(e, q0), action(e, q1), s0 + chi0, h)
    return moved + chi0 - chi1 - value(L_d, q0, q1, s0, h)


def noether_defect(
    f: ScalarField,
    start: Triple,
    end: Triple,
    c: Tensor,  # (...)
) -> Tensor:
    """f(x1) − c f(x0), shape (...): zero along the motion for the momentum f(q, p, s) of a symmetry.

    `start` and `end` are (q, p, s) before and after a step with conformal factor c, or k steps with the factor σ.
    """
    return f(*end) - c * f(*start)


def dissipation_defect(H: Hamiltonian, f: ScalarField, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
    """ḟ + H_s f along X_H, which is {H, f}; shape (...). Zero for H itself and for the momentum of a symmetry of H."""
    return jacobi_bracket(H, f)(q, p, s)
