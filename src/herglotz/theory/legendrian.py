"""Contact manifolds: Legendrian submanifolds, and the graph of a contact map as such a submanifold (erratum E1).

A submanifold of T*Q × R is Legendrian if its dimension is that of Q, n, and η = ds − p·dq vanishes on the submanifold.
The first prolongation of a function, j¹F: q ↦ (q, dF, F), is Legendrian. So is the graph of a contact map in the
contact product T*Q̂×R × T*Q×R × R with the form τη̂ − η, whose Darboux coordinates over (q̂, q, ŝ) are

    momenta (τp̂, −p, −τ),    last coordinate z = −s.

Hence the graph of Φ̃ with τ = σ is j¹W of W = −(ŝ + S), and not of the printed +(ŝ + S).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.contact import Triple, contact_form, jacobian, join, split
from herglotz.theory.function_germ import Function
from herglotz.theory.jacobi import sharp_bivector


@dataclass(frozen=True)
class LegendrianDefect:
    """How far a parametrised set is from a Legendrian submanifold.

    `pullback` is η on the tangent vectors ∂/∂u_i, zero if the set is Legendrian. `spread` is the smallest singular
    value of the parametrisation, zero where the set is no submanifold.
    """

    pullback: Tensor  # (..., n)
    spread: Tensor  # (...)


def legendrian_defect(submanifold: Callable[[Tensor], Triple], u: Tensor) -> LegendrianDefect:
    """The pull-back of η along u ↦ (q, p, s), at parameters u of shape (..., n).

    Raise InputError if the number of parameters is not n.
    """
    x, T = jacobian(lambda u: join(*submanifold(u)), u)
    _, p, _ = split(x)
    if u.shape[-1] != p.shape[-1]:
        raise InputError(
            f"a Legendrian submanifold has dimension n = {p.shape[-1]}, got {u.shape[-1]} parameters; give n of them"
        )
    pullback = (contact_form(p)[..., None, :] @ T)[..., 0, :]
    return LegendrianDefect(pullback, torch.linalg.svdvals(T)[..., -1])


def contact_complement(p: Tensor, tangent: Tensor) -> Tensor:
    """Columns that span Ξ^⊥ = ♯_Λ(Ξ°), for the span Ξ of the columns of `tangent`, (..., 2n+1, m).

    N is Legendrian exactly where TN^⊥ = TN.

    Source: contact complement in the paper.
    """
    m = tangent.shape[-1]
    annihilator = torch.linalg.svd(tangent, full_matrices=True)[0][..., m:]
    return sharp_bivector(p[..., None, :], annihilator.mT).mT


def contact_product_point(start: Triple, end: Triple, tau: Tensor) -> Triple:
    """A point (x̂, x, τ) of the contact product in the Darboux coordinates of T*(Q̂×Q×R) × R.

    `start` and `end` are (q̂, p̂, ŝ) and (q, p, s); on the graph of a map with conformal factor σ, `tau` is σ. The base
    is (q̂, q, ŝ), the momenta are (τp̂, −p, −τ), both (..., 2n+1), and z = −s.
    """
    (q0, p0, s0), (q1, p1, s1) = start, end
    return join(q0, q1, s0), torch.cat([tau[..., None] * p0, -p1, -tau[..., None]], -1), -s1


def contact_product_states(base: Tensor, momenta: Tensor, z: Tensor) -> tuple[Triple, Triple, Tensor]:
    """Inverse of `contact_product_point`: ((q̂, p̂, ŝ), (q, p, s), τ)."""
    (q0, q1, s0), (pushed, minus_p1, minus_tau) = split(base), split(momenta)
    tau = -minus_tau
    return (q0, pushed / tau[..., None], s0), (q1, -minus_p1, -z), tau


def product_potential(S: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Function:
    """W(q̂, q, ŝ) = −(ŝ + S(q̂, q, ŝ)) of the base point (..., 2n+1): j¹W is the graph of the map that S generates.

    Source: generating functions of the paper with the sign of erratum E1.
    """

    def W(base: Tensor) -> Tensor:
        q0, q1, s0 = split(base)
        return -(s0 + S(q0, q1, s0))

    return W
