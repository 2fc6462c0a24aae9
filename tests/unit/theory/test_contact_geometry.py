"""The Jacobi structure of T*Q × R, the contact and the evolution field."""

from functools import partial

import pytest
import torch

from herglotz.mechanics import contact_form, flow_derivative
from herglotz.mechanics.contact import join, split
from herglotz.theory import (
    bivector,
    contact_curvature,
    contact_vector_field,
    differential,
    divergence,
    evolution_vector_field,
    flat,
    jacobi_bracket,
    lie_derivative_of_contact_form,
    reeb_field,
    sharp,
    sharp_bivector,
)


def H(q, p, s):
    """Nonlinear in everything, s included; two degrees of freedom."""
    kinetic = 0.5 * (p * p).sum(-1) / (1 + 0.3 * torch.cos(q[..., 0])) + 0.2 * p[..., 0] * p[..., 1]
    return kinetic + torch.cos(q[..., 0] * q[..., 1]) + 0.3 * s + 0.1 * torch.sin(s) * (1 + q[..., 1] + p[..., 0])


def f(q, p, s):
    return torch.sin(q[..., 0]) * p[..., 1] + s * s * q[..., 1] + p[..., 0] ** 3


def g(q, p, s):
    return q[..., 0] * p[..., 1] - torch.exp(0.3 * q[..., 1]) * s + p[..., 0] * p[..., 1]


def points(batch=7, n=2, dtype=torch.float64, seed=0):
    x = torch.randn(batch, 2 * n + 1, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return split(x.to(dtype))


def vectors(count, batch=7, n=2):
    make = torch.Generator().manual_seed(1)
    return torch.randn(count, batch, 2 * n + 1, generator=make, dtype=torch.float64).unbind(0)


def eta(p, X):
    return (contact_form(p) * X).sum(-1)


def close(a, b, tolerance=1e-12):
    torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)


def test_d_eta_is_the_derivative_of_eta():
    # fails if dη has the other sign: dη(X, Y) = X(η(Y)) − Y(η(X)) for constant X, Y, by the derivative of (−p, 0, 1)
    X, Y = vectors(2)
    along_X = -(split(X)[1] * split(Y)[0]).sum(-1)  # X(η(Y)), only the dp of X moves η
    along_Y = -(split(Y)[1] * split(X)[0]).sum(-1)
    close(contact_curvature(X, Y), along_X - along_Y)
    close(contact_curvature(X, X), torch.zeros(7, dtype=torch.float64))


def test_reeb_field():
    # fails if R has a q or p part
    _, p, _ = points()
    R = reeb_field(p)
    close(eta(p, R), torch.ones(7, dtype=torch.float64))
    close(contact_curvature(R, vectors(1)[0]), torch.zeros(7, dtype=torch.float64))
    close(flat(p, R), contact_form(p))


def test_flat_is_its_definition_and_sharp_its_inverse():
    # fails if ι_X dη has the other sign or η(X)η is left out; ♭(X)(Y) = dη(X, Y) + η(X)η(Y) for every Y
    _, p, _ = points()
    X, Y = vectors(2)
    close((flat(p, X) * Y).sum(-1), contact_curvature(X, Y) + eta(p, X) * eta(p, Y))
    close(sharp(p, flat(p, X)), X)
    close(flat(p, sharp(p, Y)), Y)


def test_bivector_and_its_sharp():
    # fails if Λ and ♯_Λ disagree (the paper gives both), or ♯_Λ does not kill η
    _, p, _ = points()
    a, b = vectors(2)
    close((sharp_bivector(p, a) * b).sum(-1), bivector(p, a, b))
    close(bivector(p, a, b), -bivector(p, b, a))
    close(sharp_bivector(p, a), sharp(p, a) - a[..., -1:] * reeb_field(p))
    close(sharp_bivector(p, contact_form(p)), torch.zeros_like(a))


def test_the_contact_field_by_its_characterisation():
    # fails if X_H has a wrong sign anywhere: ♭(X_H) = dH − (R(H) + H)η, ι_{X_H}η = −H
    q, p, s = points()
    dH, value = differential(H, q, p, s), H(q, p, s)
    X = join(*contact_vector_field(H, q, p, s))
    E = join(*evolution_vector_field(H, q, p, s))
    close(flat(p, X), dH - (dH[..., -1] + value)[..., None] * contact_form(p))
    close(eta(p, X), -value)
    close(eta(p, E), torch.zeros_like(value))
    close(E, X + value[..., None] * reeb_field(p))
    close(E, sharp_bivector(p, dH))


def test_energy_rates():
    # fails if X_H and E_H are exchanged: X_H(H) = −R(H)H, E_H(H) = 0
    q, p, s = points()
    dH, value = differential(H, q, p, s), H(q, p, s)
    close((dH * join(*contact_vector_field(H, q, p, s))).sum(-1), -dH[..., -1] * value)
    close((dH * join(*evolution_vector_field(H, q, p, s))).sum(-1), torch.zeros_like(value))


def test_lie_derivative_of_eta():
    # fails if the flow of X_H is not by contact maps: L_X η = −R(H)η, measured by differentiating the field
    q, p, s = points()
    dH = differential(H, q, p, s)
    conformal = -dH[..., -1:] * contact_form(p)
    close(lie_derivative_of_contact_form(partial(contact_vector_field, H), q, p, s), conformal)
    evolution = lie_derivative_of_contact_form(partial(evolution_vector_field, H), q, p, s)
    close(evolution, dH + conformal)
    # fails if the check accepts any field: E_H is not a contact field
    assert (evolution - conformal).abs().amax() > 0.1


def test_the_contact_form_is_not_degenerate():
    # fails if η ∧ (dη)ⁿ vanishes anywhere: dη + η ⊗ η is ♭, a matrix of determinant 1
    _, p, _ = points()
    columns = torch.eye(5, dtype=torch.float64)
    flats = torch.stack([flat(p, e.expand(7, 5)) for e in columns], -1)
    close(torch.linalg.det(flats), torch.ones(7, dtype=torch.float64))


def test_volume_rate():
    # fails if X_H shrinks volume by another power: div X_H = −(n+1) R(H), and −n R(H) for E_H
    q, p, s = points()
    rate = differential(H, q, p, s)[..., -1]
    close(divergence(partial(contact_vector_field, H), q, p, s), -3 * rate)
    close(divergence(partial(evolution_vector_field, H), q, p, s), -2 * rate)


def test_bracket_is_the_commutator_of_contact_fields():
    # fails if a Reeb term of the bracket has the wrong sign: [X_f, X_g] = X_{f,g}, by differentiating both fields
    q, p, s = points()
    X, DX = flow_derivative(partial(contact_vector_field, f), q, p, s)
    Y, DY = flow_derivative(partial(contact_vector_field, g), q, p, s)
    commutator = (DY @ join(*X)[..., None] - DX @ join(*Y)[..., None])[..., 0]
    close(commutator, join(*contact_vector_field(jacobi_bracket(f, g), q, p, s)), 1e-11)
    close(eta(p, commutator), -jacobi_bracket(f, g)(q, p, s), 1e-11)
    derivative = (differential(g, q, p, s) * join(*X)).sum(-1)
    close(jacobi_bracket(f, g)(q, p, s), derivative + g(q, p, s) * differential(f, q, p, s)[..., -1])


def test_jacobi_identity():
    # fails if the bracket is no Lie bracket, or loses its graph when nested
    x = points()
    cyclic = [jacobi_bracket(a, jacobi_bracket(b, c))(*x) for a, b, c in ((f, g, H), (g, H, f), (H, f, g))]
    assert max(float(c.abs().max()) for c in cyclic) > 1
    close(sum(cyclic), torch.zeros(7, dtype=torch.float64), 1e-11)
    close(jacobi_bracket(f, g)(*x), -jacobi_bracket(g, f)(*x))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_shapes_dtypes_and_samples(dtype):
    # fails if samples interact, a dtype changes, or an unbatched point is refused
    q, p, s = points(dtype=dtype)
    all_ = join(*contact_vector_field(H, q, p, s))
    one = join(*contact_vector_field(H, q[2], p[2], s[2]))
    assert all_.dtype == dtype
    torch.testing.assert_close(all_[2], one)
    assert not all_.requires_grad
    assert jacobi_bracket(f, g)(q[2], p[2], s[2]).shape == ()
