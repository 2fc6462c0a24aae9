"""Scenes with a force beside the Lagrangian's: their rules keep their order, and their flow is no contact flow."""

import math

import pytest
import torch

from herglotz.mechanics import Driven, Forced, contact_defect, flow_derivative, partials
from herglotz.scenes import scene
from herglotz.stepping import Stepper


def start(count=5, seed=0):
    make = torch.Generator().manual_seed(seed)
    q, p = (torch.rand(count, 1, generator=make, dtype=torch.float64) * 2 - 1 for _ in range(2))
    return 1.5 * q, p, torch.zeros(count, dtype=torch.float64)


def error(rule, parts, mu=0.9, time=1.6):
    system = scene("van_der_pol", mu=mu)
    q, p, s = start()
    with torch.no_grad():
        out = Stepper(system.L_d_rules[rule]).rollout(q, p, s, h=time / parts, steps=parts)
        assert bool(out.ok.all())
        return float((out.q[:, -1] - system.flow(q, p, s, time)[0]).abs().max())


@pytest.mark.parametrize(("rule", "order"), [("left", 1), ("midpoint_heun", 2), ("trapezoid", 2)])
def test_a_rule_with_forces_keeps_its_order(rule, order):
    # fails if a discrete force has another sign or factor than in the flow, or acts at one end only
    slope = math.log2(error(rule, 32) / error(rule, 64))
    assert order - 0.2 < slope < order + 0.2


def test_the_cycle_of_van_der_pol():
    # fails if the damping is positive near 0 (the motion would die), or another μ is simulated. Amplitude and period
    # at μ = 1 from the literature: 2.00862 and 6.66329 (Andersen & Geer, SIAM J. Appl. Math. 42 (1982) 678)
    system = scene("van_der_pol", mu=1.0)
    q, p, s = (torch.tensor(x, dtype=torch.float64) for x in ([[0.01]], [[0.0]], [0.0]))
    parts = torch.linspace(0.05, 0.5, 10, dtype=torch.float64)  # ten samples a flow
    h, positions = 0.05, []
    with torch.no_grad():
        for k in range(70):  # it grows for 11 units of time; one turn later the cycle is reached to 1e-3 of the rest
            q, p, s = (x.expand(10, *x.shape[1:]) for x in (q[-1:], p[-1:], s[-1:]))
            q, p, s = system.flow(q, p, s, parts)
            if k >= 40:
                positions += q[:, 0].tolist()
    x = torch.tensor(positions)
    assert abs(float(x.abs().max()) - 2.00862) < 2e-3  # a sample every 0.05 misses the top by less
    up = ((x[:-1] < 0) & (x[1:] >= 0)).nonzero()[:, 0]
    times = [float(k) + float(-x[k] / (x[k + 1] - x[k])) for k in up]
    assert abs((times[-1] - times[0]) / (len(times) - 1) * h - 6.66329) < 2e-3


def test_the_flow_is_no_contact_map():
    # fails if the negative control of the contact tests is lost: a force beside L must be seen
    system = scene("van_der_pol", mu=1.4)
    q, p, s = start()
    (_, p1, _), D = flow_derivative(lambda q, p, s: system.flow(q, p, s, 0.2), q, p, s)
    assert float(contact_defect(D, p, p1, torch.ones_like(s)).abs().max()) > 1e-2
    assert system.numerical is None


def test_rules_carry_their_forces_and_inputs():
    # fails if a rule forgets the force, or a scene without inputs claims to take them
    van_der_pol, servo = scene("van_der_pol"), scene("servo_axis")
    q, p, s = start()
    for name, rule in van_der_pol.L_d_rules.items():
        assert isinstance(rule, Forced), name
        assert not isinstance(rule, Driven), name
        assert partials(rule, q, q + 0.1 * p, s, 0.1, 2).force is not None, name
    rule = servo.L_d_rules["midpoint_heun"]
    assert isinstance(rule, Driven)
    at = rule.at(torch.full((5, 1), 3.0, dtype=torch.float64))
    minus, plus = at.forces(q, q + 0.1 * p, s, torch.tensor(0.1, dtype=torch.float64))  # type: ignore[attr-defined]
    wanted = -0.05 * 20.4 * torch.tanh(p / 0.01)
    torch.testing.assert_close(plus, wanted)
    torch.testing.assert_close(minus, wanted)
