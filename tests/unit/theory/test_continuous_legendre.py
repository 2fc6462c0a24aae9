"""Herglotz's equations, and the continuous Legendre transform both ways."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import contact_form, flow_derivative
from herglotz.scenes import scene
from herglotz.theory import (
    contact_vector_field,
    derivatives,
    fiber_derivative,
    fiber_inverse,
    herglotz_acceleration,
    legendre_dual,
)


def L(q, v, s):
    """Mass that depends on q, coupling, a quartic in v, and damping that depends on q, v and s."""
    kinetic = 0.5 * (1 + 0.3 * torch.sin(q[..., 1])) * v[..., 0] ** 2 + 0.6 * v[..., 1] ** 2
    kinetic = kinetic + 0.2 * v[..., 0] * v[..., 1] * torch.cos(q[..., 0]) + 0.05 * (v * v).sum(-1) ** 2
    potential = torch.cos(q[..., 0] * q[..., 1]) + 0.25 * (q * q).sum(-1)
    return kinetic - potential - 0.3 * s - 0.1 * torch.sin(s) * (1 + 0.2 * q[..., 1]) - 0.05 * s * v[..., 0]


def points(batch=6, seed=0):
    x = torch.randn(batch, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return x[:, :2], x[:, 2:4], x[:, 4]


def close(a, b, tolerance=1e-12):
    torch.testing.assert_close(a, b, rtol=tolerance, atol=tolerance)


def test_acceleration_of_known_systems():
    # fails if L_s L_v, L_vq v or L_vs L has the wrong sign or is left out
    q, v, s = points()
    q, v = q[:, :1], v[:, :1]
    oscillator = scene("damped_oscillator")
    close(herglotz_acceleration(oscillator.lagrangian, q, v, s), -q - 0.2 * v)
    fall = scene("parachute")  # q̈ = λ q̇² − g; here L_vs ≠ 0
    lam, gravity = fall.parameters["lam"], fall.parameters["g"]
    close(herglotz_acceleration(fall.lagrangian, q, v, s), lam * v**2 - gravity, 1e-11)


def test_herglotz_equations_are_the_contact_hamilton_equations():
    # fails if FL does not carry (v, a, L) to X_H: q̇ = v, ṡ = L, and ṗ = L_vq v + L_vv a + L_vs L
    q, v, s = points()
    H = legendre_dual(L)
    p = fiber_derivative(L, q, v, s)
    P = derivatives(L, q, v, s, order=2)
    a = herglotz_acceleration(L, q, v, s)
    q_dot, p_dot, s_dot = contact_vector_field(H, q, p, s)
    close(q_dot, v)
    close(s_dot, P.L)
    close(p_dot, (P.D12.mT @ v[..., None] + P.D22 @ a[..., None])[..., 0] + P.L[..., None] * P.D23, 1e-11)


def test_the_fibre_derivative_pulls_the_contact_form_back():
    # fails if FL moves q or s: η_L = FL*η = ds − L_v dq, which makes FL a contact map of factor 1
    q, v, s = points()
    (_, p, _), D = flow_derivative(lambda q, v, s: (q, fiber_derivative(L, q, v, s), s), q, v, s)
    close((D.mT @ contact_form(p)[..., None])[..., 0], contact_form(fiber_derivative(L, q, v, s)))


def test_the_transform_is_an_involution():
    # fails if L ↦ H ↦ L loses the value or a first derivative
    q, v, s = (0.5 * x for x in points())
    twice = legendre_dual(legendre_dual(L))
    close(twice(q, v, s), L(q, v, s))
    a, b = derivatives(twice, q, v, s), derivatives(L, q, v, s)
    close((a.D1, a.D2, a.D3), (b.D1, b.D2, b.D3), 1e-11)


def test_velocity_and_momentum_are_inverse():
    # fails if Newton stops early, or the derivatives of H are not those of the theory: H_p = v, H_q = −L_q, H_s = −L_s
    q, v, s = points()
    p = fiber_derivative(L, q, v, s)
    close(fiber_inverse(L, q, p, s), v)
    P, given = derivatives(legendre_dual(L), q, p, s, order=2), derivatives(L, q, v, s, order=2)
    close((P.D2, P.D1, P.D3), (v, -given.D1, -given.D3), 1e-11)
    close(P.D22 @ given.D22, torch.eye(2, dtype=torch.float64).expand(6, 2, 2), 1e-11)


def test_scenes_agree_with_the_general_transform():
    # fails if a scene's H is not the transform of its L
    for name in ("damped_oscillator", "parachute", "damped_pendulum"):
        system = scene(name)
        q, v, s = points()
        q, v = q[:, :1], v[:, :1]
        p = system.momentum(q, v, s)
        close(fiber_derivative(system.lagrangian, q, v, s), p)
        close(legendre_dual(system.lagrangian)(q, p, s), system.hamiltonian(q, p, s))
        close(legendre_dual(system.hamiltonian)(q, v, s), system.lagrangian(q, v, s))


def test_one_velocity_is_found_for_many_actions():
    # fails if derivatives by the velocity that samples share are sums over samples: no velocity was found
    q, p, s = torch.tensor([0.3, -0.2]).double(), torch.tensor([0.5, 0.4]).double(), torch.linspace(-1, 1, 5).double()
    many = fiber_inverse(L, q, p, s)
    torch.testing.assert_close(many, fiber_inverse(L, q.expand(5, 2), p.expand(5, 2), s))


def test_what_cannot_be_inverted_is_named():
    # fails if a momentum that no velocity has gives NaN or a number
    def bounded(q, v, s):  # noqa: ARG001
        return torch.sqrt(1 + (v * v).sum(-1))  # |p| < 1

    q = torch.zeros(3, 1, dtype=torch.float64)
    p = torch.tensor([[0.5], [1.5], [0.1]], dtype=torch.float64)
    with pytest.raises(InputError, match=r"Legendre transform: no x with f_x = \[1.5\] found at sample \(1,\)"):
        fiber_inverse(bounded, q, p, q[:, 0])
    with pytest.raises(InputError, match=r"L_vv is singular at sample \(0,\)"):
        herglotz_acceleration(lambda q, v, s: (q * v).sum(-1) + s, q, p, q[:, 0])


def test_float32():
    # fails if a constant in float64 changes the dtype, or the tolerance is that of float64
    q, v, s = (x.float() for x in points())
    back = fiber_inverse(L, q, fiber_derivative(L, q, v, s), s)
    assert back.dtype == torch.float32
    torch.testing.assert_close(back, v, rtol=1e-4, atol=1e-5)
