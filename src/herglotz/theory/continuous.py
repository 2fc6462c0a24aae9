"""Continuous dynamics: fields of H(q, p, s), Herglotz's equations of L(q, v, s), Legendre transform, Theorem 1.

All functions are batched over leading dimensions. A result can be differentiated again where an argument wants a
gradient.

The Legendre transform p = L_v, H = v·L_v − L has the inverse v = H_p, L = p·H_p − H: the transform is an involution, so
one function serves both directions. The dual of f(q, x, s) is f*(q, y, s) = x·y − f(q, x, s) with f_x(q, x, s) = y.

Theorem 1 says when a field is tangent to the section γ = j¹F of T*Q × R → Q:

    continuous   Tγ(X^γ) = X_H∘γ  ⇔  H∘γ = 0            for the contact field X_H
                 Tγ(E^γ) = E_H∘γ  ⇔  d(H∘γ) = 0         for the evolution field E_H

with the projected field X^γ = Tρ(X∘γ) on Q. The paper prints the second condition for the first field. H = p and F = q
is a counterexample: d(H∘γ) = 0, and X_H is not related (erratum E2).
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.contact import jacobian, join
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import Hamiltonian, Lagrangian, ScalarField, derivatives, gradient
from herglotz.theory.contact_manifolds import Field, Function, prolongation


def contact_vector_field(
    H: Hamiltonian,
    q: Tensor,  # (..., n)
    p: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> tuple[Tensor, Tensor, Tensor]:
    """X_H: q̇ = H_p, ṗ = −(H_q + p H_s), ṡ = p·H_p − H.

    Source: contact Hamilton equations of the paper.
    """
    q_dot, p_dot, heat = evolution_vector_field(H, q, p, s)
    return q_dot, p_dot, heat - H(q, p, s)


def evolution_vector_field(
    H: Hamiltonian,
    q: Tensor,  # (..., n)
    p: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> tuple[Tensor, Tensor, Tensor]:
    """E_H = X_H + H ∂_s: q̇ = H_p, ṗ = −(H_q + p H_s), ṡ = p·H_p. H is constant along E_H, and η(E_H) = 0.

    Source: erratum E2; Theorem 1 of the paper holds as printed for E_H.
    """
    P = derivatives(H, q, p, s)
    return P.D2, -(P.D1 + p * P.D3[..., None]), (p * P.D2).sum(-1)


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


def fiber_derivative(
    f: ScalarField,
    q: Tensor,  # (..., n)
    x: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> Tensor:
    """f_x(q, x, s), shape (..., n): the momentum p = L_v of a Lagrangian, the velocity v = H_p of a Hamiltonian."""
    return derivatives(f, q, x, s).D2


def fiber_inverse(
    f: ScalarField,
    q: Tensor,  # (..., n)
    y: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> Tensor:
    """The x with f_x(q, x, s) = y, by Newton's method from y: v of a momentum (f = L), p of a velocity (f = H).

    x is once differentiable with respect to q, y and s, by the implicit-function theorem. Raise InputError if a sample
    does not converge; the message names the sample.
    """
    q, y = torch.broadcast_tensors(q, y)

    def missed(x: Tensor) -> Tensor:
        return fiber_derivative(f, q, x, s) - y

    root = find_root(lambda x: jacobian(missed, x), y)
    if not bool(root.converged.all()):
        sample = tuple(int(i) for i in (~root.converged).nonzero()[0])
        raise InputError(
            f"Legendre transform: no x with f_x = {y[sample].tolist()} found at sample {sample} (after "
            f"{root.iterations} Newton steps); check that a solution exists and that f_xx is not singular"
        )
    return root.with_slope(missed)


def legendre_dual(f: ScalarField) -> ScalarField:
    """The Legendre transform f*(q, y, s) = x·y − f(q, x, s) with f_x = y: L ↦ H and H ↦ L.

    The value is stationary in x. The first derivative of x therefore makes f* correct up to its third derivatives. f*
    raises `InputError` where `fiber_inverse` does.
    """

    def dual(q: Tensor, y: Tensor, s: Tensor) -> Tensor:
        x = fiber_inverse(f, q, y, s)
        return (x * y).sum(-1) - f(q, x, s)

    return dual


def energy_on_section(H: Hamiltonian, F: Function, q: Tensor) -> tuple[Tensor, Tensor]:
    """H∘γ and d(H∘γ) at q, shapes (...) and (..., n), for γ = j¹F."""
    value, slope, _ = gradient(lambda q: H(*prolongation(F, q)), q)
    return value, slope


def projected_field(field: Field, F: Function, q: Tensor) -> Tensor:
    """X^γ(q) = Tρ(X(γ(q))), shape (..., n): the motion on Q along the section."""
    return field(*prolongation(F, q))[0]


def relatedness_defect(field: Field, F: Function, q: Tensor) -> Tensor:
    """Tγ(X^γ) − X∘γ at q, shape (..., 2n+1); the field is any (q, p, s) → (q̇, ṗ, ṡ).

    The defect of X_H is (0, d(H∘γ), H∘γ), that of E_H is (0, d(H∘γ), 0).

    Source: Theorem 1 of the paper, erratum E2.
    """
    value, F_q, F_qq = gradient(F, q, order=2)
    X = field(q, F_q, value)
    v = X[0]
    lifted = join(v, (F_qq @ v[..., None])[..., 0], (F_q * v).sum(-1))
    return lifted - join(*X)
