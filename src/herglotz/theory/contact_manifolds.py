"""Contact manifolds: (T*Q × R, η = ds − p·dq) as a Jacobi manifold, and its Legendrian submanifolds (erratum E1).

Vectors and covectors at a point have shape (..., 2n+1), in the order q, p, s. The maps between them depend on the point
through its momentum p alone. With dη = dq ∧ dp:

    R = ∂_s,    ♭(X) = ι_X dη + η(X) η,    ♯ = ♭⁻¹,    Λ(α, β) = −dη(♯α, ♯β),    ♯_Λ(α) = Λ(α, ·) = ♯α − α(R) R

    X_H = ♯_Λ(dH) − H R,    E_H = ♯_Λ(dH),    {f, g} = Λ(df, dg) − f R(g) + g R(f),    [X_f, X_g] = X_{f, g}

A submanifold of T*Q × R is Legendrian if its dimension is that of Q, n, and η = ds − p·dq vanishes on the submanifold.
The first prolongation of a function, j¹F: q ↦ (q, dF, F), is Legendrian. So is the graph of a contact map in the
contact product T*Q̂×R × T*Q×R × R with the form τη̂ − η, whose Darboux coordinates over (q̂, q, ŝ) are

    momenta (τp̂, −p, −τ),    last coordinate z = −s.

Hence the graph of Φ̃ with τ = σ is j¹W of W = −(ŝ + S), and not of the printed +(ŝ + S).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.contact import Triple, contact_form, jacobian, join, split
from herglotz.mechanics.partials import ScalarField, derivatives, gradient

Field = Callable[[Tensor, Tensor, Tensor], Triple]


def differential(f: ScalarField, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
    """The covector df = (f_q, f_p, f_s), shape (..., 2n+1)."""
    P = derivatives(f, q, p, s)
    return join(P.D1, P.D2, P.D3)


def reeb_field(p: Tensor) -> Tensor:
    """The field R = ∂_s with ι_R dη = 0 and η(R) = 1; shape (..., 2n+1) for p (..., n)."""
    return torch.cat([torch.zeros_like(p), torch.zeros_like(p), torch.ones_like(p[..., :1])], -1)


def contact_curvature(X: Tensor, Y: Tensor) -> Tensor:
    """dη(X, Y) = X_q·Y_p − X_p·Y_q, shape (...)."""
    (X_q, X_p, _), (Y_q, Y_p, _) = split(X), split(Y)
    return (X_q * Y_p).sum(-1) - (X_p * Y_q).sum(-1)


def flat(p: Tensor, X: Tensor) -> Tensor:
    """♭(X) = ι_X dη + η(X) η, from vectors to covectors; shape (..., 2n+1).

    Source: musical isomorphism of the paper. ♭(R) = η and ♭(X_H) = dH − (R(H) + H) η.
    """
    X_q, X_p, X_s = split(X)
    eta_X = X_s - (p * X_q).sum(-1)
    return join(-X_p - eta_X[..., None] * p, X_q, eta_X)


def sharp(p: Tensor, alpha: Tensor) -> Tensor:
    """♯ = ♭⁻¹, from covectors to vectors; shape (..., 2n+1)."""
    a_q, a_p, a_s = split(alpha)
    return join(a_p, -a_q - a_s[..., None] * p, a_s + (p * a_p).sum(-1))


def sharp_bivector(p: Tensor, alpha: Tensor) -> Tensor:
    """♯_Λ(α) = ♯α − α(R) R, with the matrix [[0, I, 0], [−I, 0, −p], [0, pᵀ, 0]]; η spans the kernel."""
    a_q, a_p, a_s = split(alpha)
    return join(a_p, -a_q - a_s[..., None] * p, (p * a_p).sum(-1))


def bivector(p: Tensor, alpha: Tensor, beta: Tensor) -> Tensor:
    """Λ(α, β) = −dη(♯α, ♯β), shape (...)."""
    return -contact_curvature(sharp(p, alpha), sharp(p, beta))


def jacobi_bracket(f: ScalarField, g: ScalarField) -> ScalarField:
    """The function {f, g} = Λ(df, dg) − f R(g) + g R(f) = X_f(g) + g R(f) of (q, p, s).

    The bracket is antisymmetric and satisfies the Jacobi identity, and [X_f, X_g] = X_{f, g}. {H, f} = 0 means that f
    is dissipated as H is: ḟ = −H_s f along X_H.

    Source: the Jacobi structure of a contact manifold, with Λ as in the paper and E = −R.
    """

    def bracket(q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        F, G = derivatives(f, q, p, s), derivatives(g, q, p, s)
        df, dg = join(F.D1, F.D2, F.D3), join(G.D1, G.D2, G.D3)
        return (sharp_bivector(p, df) * dg).sum(-1) - F.L * G.D3 + G.L * F.D3

    return bracket


def divergence(field: Field, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
    """Div X with L_X Ω = (div X) Ω for the volume form Ω = η ∧ (dη)ⁿ, shape (...), by autograd on the field.

    Ω is ± n! times the volume of the coordinates (q, p, s), so div X is the trace of DX; div X_H = −(n+1) R(H).
    """
    return jacobian(lambda x: join(*field(*split(x))), join(q, p, s))[1].diagonal(dim1=-2, dim2=-1).sum(-1)


def lie_derivative_of_contact_form(field: Field, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
    """L_X η = DXᵀη − (X_p, 0, 0) of a vector field X(q, p, s), shape (..., 2n+1), by autograd on the field.

    L_X η is −R(H) η for X_H, and dH − R(H) η for E_H.
    """
    X, DX = jacobian(lambda x: join(*field(*split(x))), join(q, p, s))
    turned = (DX.mT @ contact_form(p)[..., None])[..., 0]
    X_p = split(X)[1]
    return turned - join(X_p, torch.zeros_like(X_p), torch.zeros_like(X_p[..., 0]))


# F(q), (..., n) → (...).
Function = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class FunctionGerm:
    """A function on Q with its first two derivatives at a point."""

    S: Tensor  # (...)
    dS: Tensor  # (..., n)
    d2S: Tensor  # (..., n, n)


@runtime_checkable
class HasGerm(Protocol):
    """A function on Q with derivatives in closed form."""

    def germ(self, q: Tensor, /) -> FunctionGerm:
        """Value, gradient and Hessian at q."""
        ...


def germ(F: Function, q: Tensor) -> FunctionGerm:
    """Value, gradient and Hessian of F at q, by the method `germ` of F or else by autograd."""
    return F.germ(q) if isinstance(F, HasGerm) else FunctionGerm(*gradient(F, q, order=2))


def prolongation(F: Function, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """γ(q) = j¹F(q) = (q, dF(q), F(q)), shapes (..., n), (..., n), (...).

    Source: first prolongation in the paper; with F = S_d^k the section γ^k.
    """
    if isinstance(F, HasGerm):
        at = F.germ(q)
        return q, at.dS, at.S
    value, F_q, _ = gradient(F, q)
    return q, F_q, value


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
