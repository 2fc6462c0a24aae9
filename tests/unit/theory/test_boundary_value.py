"""Discrete curves with fixed ends against stepping, the Cauchy problem, conjugate points."""

import pytest
import torch

from herglotz.scenes import scene
from herglotz.stepping import Status, StepError, Stepper
from herglotz.theory import boundary_value, initial_value
from tests.compared import relative
from tests.lagrangians import nonlinear

OSCILLATOR = scene("damped_oscillator")
CONJUGATE = 3.15741941699827646  # π/ω, section 4
CASES = {
    "nonlinear": (nonlinear, 2, 0.1, 0.0),
    "oscillator": (OSCILLATOR.L_d, 1, 0.1, 0.0),
    "parachute": (scene("parachute").L_d, 1, 0.1, 100.0),
    "pendulum midpoint": (scene("damped_pendulum").L_d_rules["midpoint"], 1, 0.1, 0.0),
}


def motion(name, steps, count=6, irregular=False):
    L_d, n, h, shift = CASES[name]
    make = torch.Generator().manual_seed(3)
    x = torch.randn(count, 2 * n + 1, generator=make, dtype=torch.float64)
    size = h * torch.ones(count, steps, dtype=torch.float64)
    if irregular:
        size = size * (0.5 + torch.rand(count, steps, generator=make, dtype=torch.float64))
    out = Stepper(L_d).rollout(x[:, :n] + shift, x[:, n : 2 * n], x[:, -1], h=size)
    assert bool(out.ok.all())
    return L_d, size, out


@pytest.mark.parametrize("irregular", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_fixed_ends_give_the_stepped_motion(name, irregular):
    # fails if a block of the second variation, the coupling through s or the indices of E3 are wrong
    L_d, h, out = motion(name, 10, irregular=irregular)
    curve = boundary_value(L_d, out.q[:, 0], out.q[:, -1], out.s[:, 0], h=h)
    assert bool(curve.ok.all()), curve.failures()
    for value, expected in zip((curve.q, curve.p, curve.s, curve.sigma), (out.q, out.p, out.s, out.sigma), strict=True):
        assert relative(value, expected) < 1e-12
    assert bool((curve.opening.crossed == -1).all())
    assert curve.iterations <= 8  # fails if a wrong Jacobian makes Newton linear


@pytest.mark.parametrize("steps", [1, 2])
def test_shortest_curves(steps):
    # fails if no unknown, or one, is a special shape somewhere
    L_d, h, out = motion("nonlinear", steps)
    curve = boundary_value(L_d, out.q[:, 0], out.q[:, -1], out.s[:, 0], h=h)
    assert relative(curve.p, out.p) < 1e-12
    alone = boundary_value(L_d, out.q[0, 0], out.q[0, -1], out.s[0, 0], h=h[0])
    assert alone.q.shape == (steps + 1, 2)
    assert relative(alone.q, out.q[0]) < 1e-12


@pytest.mark.parametrize("name", CASES)
def test_the_cauchy_problem(name):
    # fails if (q0, q1, s0) is not mapped by FL⁻ and FL⁺, or the first factor is missing in σ
    L_d, h, out = motion(name, 6, irregular=True)
    again = initial_value(L_d, out.q[:, 0], out.q[:, 1], out.s[:, 0], h=h)
    assert again.q.shape == out.q.shape
    for value, expected in zip((again.q, again.p, again.s, again.sigma), (out.q, out.p, out.s, out.sigma), strict=True):
        assert relative(value, expected) < 1e-11
    one = initial_value(L_d, out.q[:, 0], out.q[:, 1], out.s[:, 0], h=h[:, :1])
    assert torch.equal(one.q, out.q[:, :2])


def test_conjugate_ends_are_singular_and_spare_their_neighbours():
    # fails if the caustic at Nh = π/ω is stepped over, or a singular sample spoils the batch
    h = torch.tensor([[CONJUGATE / 10], [0.1]], dtype=torch.float64).expand(2, 10)
    q0, q1 = torch.ones(2, 1, dtype=torch.float64), torch.full((2, 1), 0.8, dtype=torch.float64)
    curve = boundary_value(OSCILLATOR.L_d, q0, q1, torch.zeros(2, dtype=torch.float64), h=h)
    assert curve.status.tolist() == [Status.SINGULAR, Status.CONVERGED]
    assert curve.q[0].isnan().all()
    assert float(curve.opening.final[0]) < 1e-13
    assert len(curve.failures()) == 1
    assert "sample (0,): SINGULAR: caustic" in curve.failures()[0]
    with pytest.raises(StepError, match=r"no discrete curve at sample \(0,\): SINGULAR: caustic"):
        boundary_value(OSCILLATOR.L_d, q0, q1, torch.zeros(2, dtype=torch.float64), h=h, throw=True)


def test_beyond_a_conjugate_point_the_curve_is_found_and_said_to_have_crossed():
    # fails if crossing is not noticed, or elimination breaks where a leading part is singular: here exactly at node 10
    h = CONJUGATE / 10
    q, p, s = (torch.tensor(x, dtype=torch.float64) for x in ([1.0], [0.5], 0.3))
    out = Stepper(OSCILLATOR.L_d).rollout(q, p, s, h=h, steps=15)
    curve = boundary_value(OSCILLATOR.L_d, q, out.q[-1], s, h=h, steps=15)
    assert int(curve.status) == Status.CONVERGED
    assert relative(curve.q, out.q) < 1e-11
    assert int(curve.opening.crossed) in (9, 10)


def test_no_solution_has_a_status():
    # fails if Newton's last iterate is returned where the equation has no root: R_1 = 1 + q_1² here
    def rootless(q0, q1, s0, h):
        q = q0[..., 0]
        return q + q**3 / 3 + 0 * q1[..., 0] + 0 * s0 * h

    x = torch.full((3, 1), 0.7, dtype=torch.float64)
    curve = boundary_value(rootless, x, x, x[:, 0], h=0.1, steps=2)
    assert not bool(curve.ok.any())
    assert bool(curve.q.isnan().all())


def test_float32():
    # fails if float64 gets in or a tolerance is fixed
    L_d, h, out = motion("pendulum midpoint", 10)
    curve = boundary_value(L_d, out.q[:, 0].float(), out.q[:, -1].float(), out.s[:, 0].float(), h=h.float())
    assert bool(curve.ok.all()), curve.failures()
    assert curve.q.dtype == torch.float32
    assert relative(curve.q.double(), out.q) < 1e-5


def test_many_points():
    # fails if elimination loses its digits along a long curve: 400 points in a linear problem, against the closed form
    q, p, s = (torch.tensor(x, dtype=torch.float64) for x in ([1.0], [0.5], 0.3))
    end, p1, s1 = OSCILLATOR.flow(q, p, s, 2.0)
    curve = boundary_value(OSCILLATOR.L_d, q, end, s, h=0.005, steps=400)
    assert curve.iterations <= 2
    assert relative(curve.p[-1], p1) < 1e-9
    assert abs(float(curve.s[-1] - s1)) < 1e-11
