"""Legendrian submanifolds, and the graph of a contact map in the contact product (erratum E1)."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics.contact import jacobian, join, split
from herglotz.scenes import scene
from herglotz.stepping import State, Stepper
from herglotz.theory import (
    contact_complement,
    contact_product_point,
    contact_product_states,
    legendrian_defect,
    product_potential,
    prolongation,
)

H = torch.tensor(0.1, dtype=torch.float64)


def F(q):
    return torch.sin(q[..., 0] * q[..., 1]) + 0.3 * q[..., 1] ** 3


def base(batch=6, n=2, seed=0):
    return torch.randn(batch, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def parachute_graph():
    """Points of the graph of one exact parachute step, for which c is not constant; and its S = L_d."""
    fall = scene("parachute", lam=0.1)
    make = torch.Generator().manual_seed(3)
    u = torch.randn(8, 3, generator=make, dtype=torch.float64)

    def step(u):
        out = Stepper(fall.L_d).step(State(*split(u)), H)
        return out.state, out.c

    return u, step, lambda q0, q1, s0: fall.L_d(q0, q1, s0, H)


def test_a_prolongation_is_legendrian():
    # fails if p is not dF, or η is not ds − p·dq
    q = base()
    defect = legendrian_defect(lambda u: prolongation(F, u), q)
    assert defect.pullback.abs().max() < 1e-14
    assert defect.spread.min() > 0.5
    _, p, s = prolongation(F, q)
    torch.testing.assert_close(p[:, 0], q[:, 1] * torch.cos(q[:, 0] * q[:, 1]))
    torch.testing.assert_close(s, F(q))


def test_what_is_not_legendrian_is_rejected():
    # fails if the check accepts a section that is no prolongation, a constant map, or a wrong dimension
    q = base()

    def twisted(u):
        _, p, s = prolongation(F, u)
        return u, p + 0.1 * torch.stack([-u[..., 1], u[..., 0]], -1), s

    assert legendrian_defect(twisted, q).pullback.abs().max() > 0.05

    def point(u):
        return torch.zeros_like(u), torch.ones_like(u), u[..., 0] * 0

    constant = legendrian_defect(point, q)
    assert constant.pullback.abs().max() == 0
    assert constant.spread.max() == 0
    with pytest.raises(InputError, match="dimension n = 2, got 1 parameters"):
        legendrian_defect(lambda u: (torch.cat([u, u], -1), torch.cat([u, u], -1), u[..., 0]), base(n=1))


def test_legendrian_means_its_own_contact_complement():
    # fails if ♯_Λ or the annihilator is wrong: TN^⊥ = TN for j¹F, and not for a twisted section
    q = base()
    for twist, equal in ((0.0, True), (0.3, False)):

        def section(u, twist=twist):
            _, p, s = prolongation(F, u)
            return join(u, p + twist * torch.stack([-u[..., 1], u[..., 0]], -1), s)

        x, T = jacobian(section, q)
        both = torch.cat([T, contact_complement(split(x)[1], T)], -1)
        values = torch.linalg.svdvals(both)
        assert bool((values[:, 1] > 0.1).all())
        assert bool((values[:, 2] < 1e-12).all()) == equal
        assert bool((values[:, 2] > 1e-3).all()) != equal


def test_the_graph_of_a_step_is_legendrian_in_the_contact_product():
    # fails if τ is not c: the graph of a contact map with conformal factor c, and with c replaced by 1
    u, step, _ = parachute_graph()

    def graph(u, power):
        end, c = step(u)
        return contact_product_point(split(u), end, c**power)

    exact = legendrian_defect(lambda u: graph(u, 1), u)
    assert exact.pullback.abs().max() < 1e-12
    assert exact.spread.min() > 1e-3
    assert legendrian_defect(lambda u: graph(u, 0), u).pullback.abs().max() > 1e-2


def test_the_prolongation_of_W_is_the_step():
    # fails if j¹W read as (x̂, x, τ) is another map than the one S generates; the printed sign gives s = −s₁, p = −p₁
    u, step, S = parachute_graph()
    end, c = step(u)
    (q0, p0, s0), (q1, p1, s1) = split(u), end
    base = torch.cat([q0, q1, s0[:, None]], -1)
    W = product_potential(S)
    errors = []
    for sign in (1, -1):
        start, image, tau = contact_product_states(*prolongation(lambda x, k=sign: k * W(x), base))
        pairs = zip((*start, *image, tau), (q0, p0, s0, q1, p1, s1, c), strict=True)
        errors.append([float((a - b).abs().max()) for a, b in pairs])
    print("W = −(ŝ + S):", errors[0], "W = ŝ + S:", errors[1])
    assert max(errors[0]) < 1e-11
    assert min(errors[1][4], errors[1][5], errors[1][6]) > 0.1
