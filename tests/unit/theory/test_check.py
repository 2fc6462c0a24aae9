"""Theorem 3 in one call, and the functions that one equation alone accepts (E10)."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.mechanics import partials
from herglotz.scenes import scene
from herglotz.theory import PointSource, Propagated, Quadratic, check, riccati_step
from tests.compared import f64
from tests.lagrangians import bowl, nonlinear

OSCILLATOR = scene("damped_oscillator").L_d


def quadratic(q0, q1, s0, h):
    """The L_d of E10."""
    return -0.07 * s0 + (0.45 * q0**2 - 1.4 * q0 * q1 + 0.55 * q1**2).sum(-1) + 0 * h


Q1, Q2 = torch.linspace(-1.5, 2.0, 15).double()[:, None], torch.rand(12, 2, generator=torch.Generator().manual_seed(0))
Q2 = Q2.double()
S = Quadratic(f64(0.7)[None], f64(-0.4), f64(0.2)[0])


def successor(L_d, S, h):
    at = partials(L_d, f64(0.0), f64(0.0), f64(0.0)[0], h, 2)
    return riccati_step(at, S)


def test_a_solution_passes():
    # fails if S, dS, H± and the step do not belong together, in one or two coordinates, exact or propagated
    assert check(quadratic, S, successor(quadratic, S, 1.0), Q1, h=1.0).passed

    found = check(nonlinear, bowl, Propagated(nonlinear, bowl, 0.2), Q2, h=0.2)
    assert found.passed, str(found)
    assert float(torch.stack([found.right, found.left, found.diagram]).max()) < 1e-11


def test_what_the_right_equation_alone_accepts_is_refused():
    # fails if the left equation or the diagram is left out (E10): δ = −½ D22 (q − κ)², measured 4.1 in the diagram
    S1, D22, kappa = successor(quadratic, S, 1.0), 1.1, 0.8

    def wrong(q):
        return S1(q) - 0.5 * D22 * ((q - kappa) ** 2).sum(-1)

    found = check(quadratic, S, wrong, Q1, h=1.0)
    assert float(found.right.max()) < 1e-13
    assert float(found.left.max()) > 0.1
    assert float(found.diagram.max()) > 0.1
    assert not found.passed
    assert "The right equation alone accepts wrong functions (erratum E10)." in found.table()


def test_what_the_left_equation_alone_accepts_is_refused():
    # fails if right and diagram are left out: by the mirror image of E10 a wrong S^k solves the left equation
    S1 = successor(quadratic, S, 1.0)
    shifted = Quadratic(S1.alpha, S1.beta, S1.delta + 1e-6)
    found = check(quadratic, S, shifted, Q1, h=1.0)
    assert not found.passed
    assert min(float(x.max()) for x in (found.right, found.left, found.diagram)) > 1e-8


def test_where_H_plus_does_not_exist_the_diagram_decides():
    # fails if a fold of H⁺ (D22 = 0: E4, L_d = −q0 q1/h + …) refuses a sound pair, or accepts a wrong one
    def product(q0, q1, s0, h):
        return -(q0 * q1).sum(-1) / h - 0.05 * s0 - 0.2 * h * (q0**2).sum(-1)

    S = Quadratic(f64(2.0)[None], f64(-0.4), f64(0.2)[0])
    S1 = successor(product, S, 0.5)
    good = check(product, S, S1, Q1, h=0.5)
    assert good.passed, str(good)
    assert "does not apply" in good.table()
    assert not check(product, S, Quadratic(S1.alpha * 1.001, S1.beta, S1.delta), Q1, h=0.5).passed


def test_a_point_source_and_a_caustic():
    # fails if points beyond a caustic, where S is no function, are counted as residuals or pass as solutions
    source = PointSource(OSCILLATOR, f64(1.0), f64(0.3)[0], 0.1)
    points = f64(0.8, 0.9, 1.0, 1.1)[:, None]
    assert check(OSCILLATOR, source, Propagated(OSCILLATOR, source, 0.1), points, h=0.1).passed
    assert not check(OSCILLATOR, source, Propagated(OSCILLATOR, source, 0.1, 40), points, h=0.1).passed


LINE = f64(0, 0, 1, 1, 2, 2).reshape(3, 2)


@pytest.mark.parametrize("points", [Q1[:0], Q1[:1], Q1[:, 0], torch.ones(5, 1).double(), LINE])
def test_what_is_no_open_set_is_refused(points):
    # fails if a single trajectory, on which every S solves both equations, is taken for a proof (E7)
    with pytest.raises(InputError, match=r"open set|spread in every direction"):
        check(quadratic, S, S, points, h=1.0)
