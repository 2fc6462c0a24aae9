"""The conclusions: Hamilton–Jacobi on Q × R, a section p = γ(q, s) of T*Q × R → Q × R tangent to the motion.

    continuous   (∂_q + γ ∂_s)(H∘γ) = (H∘γ) γ_s          where γ_q + γ ⊗ γ_s is symmetric
    discrete     γ^{k+1}(q_{k+1}, s_{k+1}) = D2 L_d,    γ^k(q_k, s_k) = −D1 L_d / c

Symmetry means that the image of γ is foliated by prolongations j¹F_a, one for each value of a parameter a.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.contact import jacobian
from herglotz.mechanics.legendre import momentum_minus, momentum_plus, momentum_residual
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import DiscreteLagrangian, Hamiltonian, derivatives, partials
from herglotz.theory.continuous import contact_vector_field

# p = γ(q, s), (..., n) and (...) → (..., n).
Section = Callable[[Tensor, Tensor], Tensor]


def section_derivatives(gamma: Section, q: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """γ, γ_q with [i, j] = ∂γ_i/∂q_j, and γ_s; shapes (..., n), (..., n, n), (..., n)."""
    p, D = jacobian(lambda x: gamma(x[..., :-1], x[..., -1]), torch.cat([q, s[..., None]], -1))
    return p, D[..., :-1], D[..., -1]


def section_asymmetry(gamma: Section, q: Tensor, s: Tensor) -> Tensor:
    """The antisymmetric part of γ_q + γ_s ⊗ γ, shape (..., n, n): zero where Legendrians foliate the image of γ."""
    p, g_q, g_s = section_derivatives(gamma, q, s)
    A = g_q + g_s[..., :, None] * p[..., None, :]
    return 0.5 * (A - A.mT)


def section_hamilton_jacobi_residual(H: Hamiltonian, gamma: Section, q: Tensor, s: Tensor) -> Tensor:
    """(∂_q + γ∂_s)(H∘γ) − (H∘γ) γ_s, shape (..., n).

    Where `section_asymmetry` is zero, the residual is zero exactly where X_H is tangent to the image of γ.

    Source: section 6 of `docs/mathematics.md`; for the damped oscillator γ = 2s/q is a solution.
    """
    p, _, g_s = section_derivatives(gamma, q, s)
    P = derivatives(lambda q, _, s: H(q, gamma(q, s), s), q, q, s)
    return P.D1 + p * P.D3[..., None] - P.L[..., None] * g_s


def section_relatedness_defect(H: Hamiltonian, gamma: Section, q: Tensor, s: Tensor) -> Tensor:
    """The p-part γ_q q̇ + γ_s ṡ − ṗ of Tγ(X^γ) − X_H∘γ, shape (..., n); the other parts are zero by definition."""
    p, g_q, g_s = section_derivatives(gamma, q, s)
    q_dot, p_dot, s_dot = contact_vector_field(H, q, p, s)
    return (g_q @ q_dot[..., None])[..., 0] + g_s * s_dot[..., None] - p_dot


def discrete_section_residuals(
    L_d: DiscreteLagrangian,
    gamma0: Section,
    gamma1: Section,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor]:
    """γ0(q0, s0) + D1 L_d / c and γ1(q1, s0 + L_d) − D2 L_d, each (..., n), in units of momentum.

    γ0 and γ1 solve the discrete equation if the second residual is zero wherever the first is zero, on an open set of
    (q0, s0).

    Source: section 6 of `docs/mathematics.md`.
    """
    P = partials(L_d, q0, q1, s0, h)
    return gamma0(q0, s0) - momentum_minus(P), gamma1(q1, s0 + P.L) - momentum_plus(P)


def transport_section(L_d: DiscreteLagrangian, gamma0: Section, h: Tensor | float) -> Section:
    """The section γ1 with im γ1 = Φ̃(im γ0): the image of γ0 under one step.

    At a point (q1, s1), Newton's method from (q1, s1) finds the point (q0, s0) whose step ends there,

        D1 L_d(q0, q1, s0) + c γ0(q0, s0) = 0,    s0 + L_d(q0, q1, s0) = s1,

    and γ1 = D2 L_d. No step of the flow is inverted. γ1 is once differentiable by the implicit-function theorem, so
    that γ1 can be transported again. γ1 raises `InputError` where no preimage is found: beyond a caustic of γ0, or if h
    is too large.
    """

    def gamma1(q1: Tensor, s1: Tensor) -> Tensor:
        def missed(x: Tensor) -> Tensor:
            q0, s0 = x[..., :-1], x[..., -1]
            P = partials(L_d, q0, q1, s0, h)
            return torch.cat([momentum_residual(P, gamma0(q0, s0)), (s0 + P.L - s1)[..., None]], -1)

        root = find_root(lambda x: jacobian(missed, x), torch.cat([q1, s1[..., None]], -1))
        if not bool(root.converged.all()):
            sample = tuple(int(i) for i in (~root.converged).nonzero()[0])
            raise InputError(
                f"no point of the section is carried to (q, s) = ({q1[sample].tolist()}, {float(s1[sample]):g}) at "
                f"sample {sample}; use a smaller h, or points nearer to the image of the section"
            )

        x = root.with_slope(missed)
        return momentum_plus(partials(L_d, x[..., :-1], q1, x[..., -1], h))

    return gamma1
