"""Time-dependent L_d(q0, q1, s0, t0, h): energies, the form η + E dt, Hamilton–Jacobi."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.scenes import ExactForcedOscillator
from herglotz.stepping import Stepper
from herglotz.theory import Propagated, TimeDependent, check, energies, hopf_lax, time_defect
from tests.lagrangians import pendulum_of_time, states_in_turn

F64 = torch.float64
EXACT = ExactForcedOscillator(0.9, 1.7, 0.6, m=1.4, omega0=1.3, gamma=0.4)


def test_a_rule_matches_energies_to_its_order():
    # fails if E± are not the energies at the ends: those of two steps meet within O(h²)
    gaps = []
    for h in (0.1, 0.05):
        out = TimeDependent(pendulum_of_time).rollout(states_in_turn(), 0.3, h, 2)
        q, s = out.q, out.s
        _, end = energies(pendulum_of_time, q[:, 0], q[:, 1], s[:, 0], 0.3, h)
        start, _ = energies(pendulum_of_time, q[:, 1], q[:, 2], s[:, 1], 0.3 + h, h)
        gaps.append(float((start - end).abs().max()))
    assert 1.8 < gaps[0] / gaps[1] < 4.5  # the plain s of this rule leaves a part of order 1


def test_the_step_keeps_the_form_with_time():
    # fails if the step is taken at another time than the energies: η + E dt is kept up to c
    for L_d in (EXACT, pendulum_of_time):
        for defect in time_defect(TimeDependent(L_d), states_in_turn(), 1.1, 0.3):
            assert float(defect.abs().max()) < 1e-13
    x, family = states_in_turn(), TimeDependent(pendulum_of_time)
    step = family.step_at(x, 1.1, 0.3)
    E0, E1 = energies(pendulum_of_time, x.q, step.state.q, x.s, 1.1, 0.3)
    size = torch.tensor(0.3, dtype=F64)
    ahead, behind = (
        pendulum_of_time(x.q, step.state.q, x.s, torch.tensor(1.1 + d, dtype=F64), size) for d in (1e-5, -1e-5)
    )
    torch.testing.assert_close(E1, step.c * E0 - (ahead - behind) / 2e-5, rtol=0, atol=1e-8)


def test_rollouts_step_at_their_times():
    # fails if a rollout starts at another time or its times do not advance by h
    x = states_in_turn()
    out = TimeDependent(EXACT).rollout(x, 0.7, 0.1, 30)
    for a, b in zip((out.q[:, -1], out.p[:, -1], out.s[:, -1]), EXACT.flow(*x, 0.7, 3.0), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-11, atol=1e-11)
    times = 0.7 + 0.1 * torch.arange(30, dtype=F64)
    same = Stepper(TimeDependent(EXACT)).rollout(*x, h=0.1, steps=30, inputs=times[:, None])
    torch.testing.assert_close(out.q, same.q)


def test_the_time_dependent_hamilton_jacobi_equation():
    # fails if H⁺ of a step is that of another time: two steps from a bowl, right, left and diagram
    points, h = torch.linspace(-1, 1, 9, dtype=F64)[:, None], 0.3
    bowl = lambda q: 0.3 * (q * q).sum(-1)  # noqa: E731
    at = [TimeDependent(pendulum_of_time, t) for t in (1.1, 1.4)]
    first = Propagated(at[0], bowl, h)
    assert check(at[0], bowl, first, points, h=h).passed
    second = Propagated(at[1], first, h)
    assert check(at[1], first, second, points, h=h, bound=1e-9).passed
    wrong = check(at[0], first, second, points, h=h, bound=1e-9)
    assert not wrong.passed
    assert float(wrong.diagram.max()) > 1e-3


def test_the_value_changes_with_time_as_the_energy():
    # fails if S_t = −E: ∂S/∂t_{k+1} of the Hopf–Lax value at fixed q, by differences; and E is H(q, S_q, S, t)
    y, bowl, t0, h = torch.linspace(-1, 1, 5, dtype=F64)[:, None], lambda q: 0.3 * (q * q).sum(-1), 1.1, 0.3
    value = lambda h: hopf_lax(TimeDependent(EXACT, t0), bowl, y, h=h, steps=1)  # noqa: E731
    slope = (value(h + 1e-4).S - value(h - 1e-4).S) / 2e-4
    here = value(h)
    H = EXACT.hamiltonian(y, here.dS, here.S, t0 + h)
    torch.testing.assert_close(slope, -H, rtol=0, atol=1e-7)


def test_what_is_refused():
    # fails if inputs that are no times go through
    with pytest.raises(InputError, match=r"is its time t0, shape \(..., 1\); got \(3,\)"):
        TimeDependent(EXACT).at(torch.zeros(3))
