"""Contact manifolds: (T*Q × R, η = ds − p·dq) as a Jacobi manifold.

Vectors and covectors at a point have shape (..., 2n+1), in the order q, p, s. The maps between them depend on the point
through its momentum p alone. With dη = dq ∧ dp:

    R = ∂_s,    ♭(X) = ι_X dη + η(X) η,    ♯ = ♭⁻¹,    Λ(α, β) = −dη(♯α, ♯β),    ♯_Λ(α) = Λ(α, ·) = ♯α − α(R) R

    X_H = ♯_Λ(dH) − H R,    E_H = ♯_Λ(dH),    {f, g} = Λ(df, dg) − f R(g) + g R(f),    [X_f, X_g] = X_{f, g}
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.mechanics.contact import Triple, contact_form, jacobian, join, split
from herglotz.mechanics.scalar_fields import ScalarField, derivatives

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
