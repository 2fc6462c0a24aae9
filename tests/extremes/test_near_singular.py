"""Scenes at their worst: a pole, a separatrix, a close pericentre, an inverted chain, a mass that vanishes."""

import math

import pytest
import torch
from extreme_cases import assert_nothing_silent, build, state

from herglotz.errors import InputError
from herglotz.export import compile_c
from herglotz.mechanics import legendre_minus
from herglotz.scenes import scene
from herglotz.stepping import OneStepMethod, State, Status, Step, Stepper
from herglotz.tune import flag_unresolved

TINY = 1e-300  # stands for no damping in scenes whose s-derivative must exist


@pytest.mark.parametrize("distance", [0.9, 0.5, 1e-1, 1e-3, 1e-6, -1e-9, -1e-3])
def test_the_parachute_up_to_its_pole(distance):
    # fails if a motion that runs off to infinity within the step is given an end, or one just short of it is wrong
    parachute, h = scene("parachute"), 0.1
    omega = math.sqrt(0.01 * 10)
    pole = omega / math.tanh(omega * h) / 0.01  # cosh ωh = (λ v0/ω) sinh ωh
    q, v, s = (torch.tensor(x, dtype=torch.float64) for x in ([[0.0]], [[pole * (1 - distance)]], [0.0]))
    start = State(q, parachute.momentum(q, v, s), s)
    with torch.no_grad():
        step = Stepper(parachute.L_d).step(start, h)
    if distance >= 0.5:  # the tolerance is relative to the first Newton step, which is long here; the residual tells
        atol = 2 * float(step.residual)
        torch.testing.assert_close(step.state.q, parachute.flow(*start, h)[0], rtol=1e-13, atol=atol)
        assert atol < 1e-9
    else:  # Newton from q0 does not get there, and says so
        assert step.status.tolist() != [Status.CONVERGED]
        assert bool(step.state.q.isnan())
    if distance > 0:  # from a better guess the solution is found up to the pole; q1 is −ln(distance)/λ: ε/distance
        exact = parachute.flow(*start, h)[0]
        with torch.no_grad():
            step = Stepper(parachute.L_d).step(start, h, guess=exact + 1.0)
        assert step.status.tolist() == [Status.CONVERGED]
        torch.testing.assert_close(step.state.q, exact, rtol=1e-12, atol=100 * 10 * 2.2e-16 / distance)


@pytest.mark.parametrize("settings", [{}, {"correction_width": 4}], ids=["explicit", "newton"])
def test_on_the_separatrix(settings):
    # fails if a motion that may stay at the top for ever, or fall to either side, is not finite, drifts in energy
    # beyond order 2, or passes the top faster than energy lets it
    model = build(level="conservative", potential_width=0, **settings)
    with torch.no_grad():
        out = Stepper(model).rollout(*state([[0.0]] * 3, [[2.0 - 1e-6], [2.0], [2.0 + 1e-6]]), h=0.05, steps=1000)
    assert bool(out.ok.all())
    energy = out.p[..., 0] ** 2 / 2 + 1 - torch.cos(out.q[..., 0])
    assert float((energy - energy[:, :1]).abs().max()) < 1.5e-3
    top = (torch.cos(out.q[..., 0]) < -0.999).sum(-1)
    assert bool((top > 60).all())  # ln of the rounding, or of what order 2 makes of it: 3 units of time at the least


@pytest.mark.parametrize("coefficient", [0.999999, 1.0, 1.5])
@pytest.mark.parametrize("order", [2, 4])
def test_a_mass_that_features_make_singular_or_indefinite(coefficient, order):
    # fails if a told mass, which no factorisation keeps positive, gives a number that is no solution: det M = 1 − a²
    model = build(dof=2, features=("pendulums",), potential_width=0, order=order)
    with torch.no_grad():
        model.kinetic.sum.coefficient.fill_(coefficient)
        start = state([[0.3, 0.3], [0.3, 0.31], [1.0, -0.5]], [[0.5, 0.5], [0.5, -0.5], [1.0, 0.2]])
        out = Stepper(model).rollout(*start, h=0.05, steps=20)
        assert_nothing_silent(out)
        # What converged solves the discrete Herglotz equation, while p, which no energy bounds here, is of a size.
        moderate = out.p.abs().amax(-1) < 1e3
        there = (out.status == Status.CONVERGED).cummin(-1).values & moderate[:, :-1] & moderate[:, 1:]
        assert int(there.sum()) > 3
        before, after = out.q[:, :-1][there], out.q[:, 1:][there]
        _, p0, _ = legendre_minus(model, before, after, out.s[:, :-1][there], 0.05)
    assert float((p0 - out.p[:, :-1][there]).abs().max()) < 1e-9


def test_the_inverted_pendulum_leaves_as_slowly_as_rounding_lets_it():
    # fails if the solver pushes: q − π grows by e^t from 1.2e-16, the rounding of π
    model = build(level="conservative", potential_width=0)
    with torch.no_grad():
        out = Stepper(model).rollout(*state([math.pi], [0.0]), h=0.05, steps=500)
    away, t = (out.q[0, :, 0] - math.pi).abs(), 0.05 * torch.arange(501, dtype=torch.float64)
    assert bool((away <= 20 * torch.finfo(torch.float64).eps * t.exp()).all())


@pytest.mark.parametrize("size", [0.0, 1e-8])
def test_the_inverted_double_pendulum_follows_its_linearisation(size):
    # fails if an unstable rest is left by more than its own growth, e^{5.8 t}: a million by t = 2
    pendulum, g, gamma = scene("double_pendulum"), 9.81, 0.1
    start = torch.tensor([size, -size], dtype=torch.float64)
    with torch.no_grad():
        out = Stepper(pendulum.L_d).rollout(*state((math.pi + start).tolist(), [0.0, 0.0]), h=0.02, steps=100)
    assert bool(out.ok.all())
    mass, weight = torch.tensor([[2.0, 1.0], [1.0, 1.0]]).double(), g * torch.tensor([2.0, 1.0]).double().diag()
    eye, zero = torch.eye(2, dtype=torch.float64), torch.zeros(2, 2, dtype=torch.float64)
    A = torch.cat([torch.cat([zero, eye], 1), torch.cat([torch.linalg.solve(mass, weight), -gamma * eye], 1)])
    flow = torch.matrix_exp(2.0 * A)
    away = out.q[0, -1] - math.pi
    if size:
        torch.testing.assert_close(away, flow[:2, :2] @ start, rtol=0.03, atol=0)
    else:  # every step leaves up to 64 ε |q|/h in the velocity, the first of them grown the most
        left = 64 * torch.finfo(torch.float64).eps * math.pi / 0.02
        assert float(away.abs().max()) < 100 * left * float(flow.abs().max())


class Leapfrog(OneStepMethod):
    """Kick, drift, kick around a sun of strength 1, without damping: explicit, of order 2."""

    def step(self, state, h, guess=None):  # noqa: ARG002
        """One step; s stays, as nothing here asks for it."""
        (q, p, s), h = state, torch.as_tensor(h, dtype=state.q.dtype)[..., None]
        p = p + h / 2 * _attraction(q)
        q = q + h * p
        p = p + h / 2 * _attraction(q)
        return Step.of(State(q, p, s), torch.ones_like(s), torch.zeros_like(s, dtype=torch.uint8), 0 * s, 0)


def kepler(e, h):
    """One revolution from the pericentre by leapfrog; the largest error of the energy −1/2."""
    out = Leapfrog().rollout(*state([1 - e, 0.0], [0.0, math.sqrt((1 + e) / (1 - e))]), h=h)
    assert_nothing_silent(out)
    energy = (out.p**2).sum(-1) / 2 - 1 / out.q.norm(dim=-1)
    momentum = out.q[..., 0] * out.p[..., 1] - out.q[..., 1] * out.p[..., 0]
    return out, float((energy + 0.5).abs().max()), float((momentum / momentum[:, :1] - 1).abs().max())


def _attraction(q):
    return -q * (q * q).sum(-1, keepdim=True) ** -1.5


def test_kepler_at_e_099_needs_steps_that_follow_the_radius():
    # fails if a step list cannot be followed through the pericentre, or the angular momentum is not kept
    e, steps = 0.99, 800
    anomaly = torch.linspace(0, 2 * math.pi, steps + 1, dtype=torch.float64)
    t = anomaly - e * torch.sin(anomaly)  # Kepler's equation: equal steps of E are steps in proportion to r
    out, energy, momentum = kepler(e, t.diff())
    assert bool(out.ok.all())
    assert momentum < 1e-12
    assert energy < 0.4
    assert float(out.q.norm(dim=-1).max()) == pytest.approx(1 + e, rel=0.2)
    # as many equal steps cross the pericentre in one: finite and wrong by orders, which no status can know
    equal, wrong, _ = kepler(e, torch.full((steps,), 2 * math.pi / steps, dtype=torch.float64))
    assert bool(equal.ok.all())
    assert wrong > 1e3 * energy


def test_equal_steps_over_the_pericentre_are_found_by_half_steps():
    # fails if a motion that is finite, converged and wrong by orders passes the one check there is for it
    e, steps = 0.99, 800
    anomaly = torch.linspace(0, 2 * math.pi, steps + 1, dtype=torch.float64)
    equal = torch.full((steps,), 2 * math.pi / steps, dtype=torch.float64)
    for h, bound, resolved in ((equal, 0.5, False), ((anomaly - e * torch.sin(anomaly)).diff(), 0.05, True)):
        out, _, _ = kepler(e, h)
        flagged = flag_unresolved(Leapfrog(), out, h, bound)
        assert bool(flagged.ok.all()) == resolved
        assert torch.equal(flagged.q, out.q)
        if not resolved:  # the steps next to the pericentre and no others
            wrong = (flagged.status[0] == Status.UNRESOLVED).nonzero()[:, 0].tolist()
            assert 0 in wrong
            assert {*wrong} <= {*range(20), *range(steps - 20, steps)}


@pytest.mark.parametrize("bound", [0.0, -1.0, math.nan, math.inf])
def test_a_bound_that_is_none_is_refused(bound):
    # fails if a bound that nothing exceeds, or everything does, is taken for an answer
    out, _, _ = kepler(0.5, torch.full((4,), 0.1, dtype=torch.float64))
    with pytest.raises(InputError, match="bound must be"):
        flag_unresolved(Stepper(scene("kepler").L_d), out, 0.1, bound)


def test_kepler_at_e_099_is_refused_by_the_reference_flow_in_one_step():
    # fails if the reference returns a number where its own error estimate says that it has none
    planet, e = scene("kepler", gamma=TINY), 0.99
    with pytest.raises(InputError, match=r"reference flow: estimated error .* use a smaller h"):
        planet.flow(*state([1 - e, 0.0], [0.0, math.sqrt((1 + e) / (1 - e))]), 2 * math.pi)


def degenerate(log_factor, **settings):
    model = build(dof=2, angles=(False, False), potential_width=0, **settings)
    with torch.no_grad():
        model.kinetic.log_diagonal.fill_(log_factor)
    return model


@pytest.mark.parametrize("settings", [{}, {"correction_width": 2}], ids=["explicit", "newton"])
@pytest.mark.parametrize("log_factor", [-5.0, -20.0, -100.0, -200.0, -400.0])
def test_a_mass_that_vanishes(log_factor, settings):
    # fails if an entry of the mass of 1e-4 … 1e-348 gives inf or NaN without a status
    with torch.no_grad():
        out = Stepper(degenerate(log_factor, **settings)).rollout(*state([1.0, 1.0], [0.5, 0.0]), h=0.1, steps=3)
    assert_nothing_silent(out)
    if log_factor <= -200:  # the square underflows, or q overflows: nothing to step
        assert out.status[0, 0] in (Status.SINGULAR, Status.DIVERGED)


def test_a_mass_that_vanishes_has_no_header():
    # fails if a singular mass is exported, or refused in the words of a linear algebra library
    with pytest.raises(InputError, match="mass"):
        compile_c(degenerate(-400.0))
