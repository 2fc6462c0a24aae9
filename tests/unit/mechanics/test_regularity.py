"""The margins of regularity, the left Hessian, the contact form and the part of a force beyond a bound."""

import pytest
import torch

from herglotz.mechanics import partials
from herglotz.mechanics.contact import contact_form
from herglotz.mechanics.legendre import left_hessian, regularity, soft_threshold
from herglotz.mechanics.newton import find_root
from tests.compared import f64


def nonlinear(q0, q1, s0, h):
    """Every block of the Hessian is there, and D11 of two coordinates is not diagonal."""
    mixed = (q0[..., 0] * q0[..., 1]) ** 2 * q1[..., 0]
    return (q0 * q1 * q1).sum(-1) + mixed + s0 * (q0[..., 0] - 0.5 * q0[..., 1] * q1[..., 1]) + s0 * s0 * h


def test_the_left_hessian_is_the_derivative_of_the_left_momentum():
    # fails if a cross term is missing or has another sign: c D1D1 L⁻ = −c dp0/dq0 where q1 and s1 stay, ds0/dq0 = p0
    q0, q1, s0, h = f64(0.7, -0.4), f64(0.3, 1.1), f64(0.2)[0], f64(0.1)[0]

    def p0(q, s):
        P = partials(nonlinear, q, q1, s, h)
        return -P.D1 / P.c[..., None]

    by_q, by_s = torch.autograd.functional.jacobian(p0, (q0, s0))
    P = partials(nonlinear, q0, q1, s0, h, order=2)
    expected = -P.c * (by_q + by_s[:, None] * p0(q0, s0)[None, :])
    torch.testing.assert_close(left_hessian(P), expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_pole_in_h_is_seen_from_either_side(side):
    # fails if only one side of h is looked at, the larger of the two counts, or the ratio is upside down: half of √eps
    # from the pole M is 1/(h − h0) = 2, the neighbours' 2 and 2/3 in units of 1/√eps
    distance = side * 0.5 * torch.finfo(torch.float64).eps ** 0.5

    def L_d(q0, q1, s0, h):
        return (q0 * q1).sum(-1) / (h - 1) + 0 * s0

    x = f64(0.5)
    near = regularity(L_d, x, x, f64(0.0)[0], 1 + distance)
    assert float(near.pole) == pytest.approx(1 / 3, rel=1e-6)
    assert float(regularity(L_d, x, x, f64(0.0)[0], 2.0).pole) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize(("slope", "margin"), [(0.5, 1.0), (-0.5, 1 / 3)])
def test_the_margin_of_c(slope, margin):
    # fails if c = 1 + D3 is not measured in units of its terms
    x = f64(0.5)
    found = regularity(lambda q0, q1, s0, h: (q0 * q1).sum(-1) + slope * s0 + 0 * h, x, x, f64(0.0)[0], 0.1)
    assert float(found.c) == pytest.approx(margin, rel=1e-14)


def test_what_is_not_finite_has_no_margin():
    # fails if one block that is not finite is outweighed by another: inf − inf, or a sign that lets it pass
    x = f64(0.0)

    def L_d(q0, q1, s0, h):
        return (q0 * q1).sum(-1) + q0.abs().sqrt().sum(-1) + 0 * s0 * h

    found = regularity(L_d, x, x + 1, x[0], 0.1)
    assert float(found.finite) == 0


def test_the_contact_form():
    # fails if the sign of p in ds − p·dq is lost
    assert contact_form(f64(1.0, 2.0)).tolist() == [-1, -2, 0, 0, 1]


def test_beyond_a_bound():
    # fails if a side of the bound is lost
    found = soft_threshold(f64(-3.0, -1.0, 0.0, 1.0, 3.0), f64(2.0))
    assert found.tolist() == [-1, 0, 0, 0, 1]


def test_errors_of_a_root_are_in_units_of_its_size():
    # fails if the size of the unknowns does not count: a root near 1e9 that rounding leaves 1e-7 off has converged
    start = f64(1.3e9)[None]
    found = find_root(lambda x: (x**3 - 1e27, torch.diag_embed(3 * x * x)), start)
    assert bool(found.converged[0])
    assert float(found.error[0]) < 1e-12
    assert float(found.x[0, 0]) == pytest.approx(1e9, rel=1e-15)


def test_the_report_names_sample_and_condition():
    # fails if a condition that holds is told, one that fails is not, or the sample is another
    def L_d(q0, q1, s0, h):  # c = 1 − q0 is 0 for the second sample, D1D1 L⁻ and D2D2 L_d for both
        return (q0 * q1).sum(-1) - q0.sum(-1) * s0 + 0 * h

    found = regularity(L_d, f64([0.5], [1.0]), f64([0.2], [0.2]), f64(0.0, 0.0), f64(0.1, 0.25))
    assert "sample (1,), h = 0.25: c = 0: FL⁻ is not defined" in found.report()
    assert not any(line.startswith("sample (0,), h = 0.1: c = 0") for line in found.report())
    assert found.lost("H_plus").tolist() == [True, True]
    one = regularity(L_d, f64(1.0), f64(0.2), f64(0.0)[0], 0.25)
    assert one.report()[0].startswith("h = 0.25: c = 0")
