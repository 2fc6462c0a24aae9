"""Time-dependent L_d through `L_d.at(t)`: a driven damped oscillator with a known solution, and a driven pendulum."""

import math

import numpy as np
import pytest
import torch

from herglotz.mechanics import contact_defect, flow_derivative
from herglotz.scenes import reference_flow
from herglotz.stepping import State, Stepper

OMEGA, GAMMA, FORCE, NU = 1.3, 0.4, 0.9, 1.7
F64 = torch.float64


class DrivenOscillator:
    """L = v²/2 − Ω²q²/2 + f q cos νt − γs by the midpoint rule with Heun's s; the input of a step is its start time."""

    def __init__(self, middle=True, pendulum=False):
        self.middle = middle  # False: the force at the start of the step, a rule of order 1
        self.pendulum = pendulum  # Ω²(1 − cos q) for Ω²q²/2

    def __call__(self, q0, q1, s0, h):
        return self.at(torch.zeros_like(q0))(q0, q1, s0, h)

    def at(self, u):
        def L_d(q0, q1, s0, h):
            t = u[..., 0] + (0.5 * h if self.middle else 0.0)
            q, v = 0.5 * (q0 + q1)[..., 0], (q1 - q0)[..., 0] / h

            def L(s):
                V = OMEGA**2 * (1 - torch.cos(q) if self.pendulum else 0.5 * q**2)
                return 0.5 * v**2 - V + FORCE * q * torch.cos(NU * t) - GAMMA * s

            return h * L(s0 + 0.5 * h * L(s0))

        return L_d


def solution(q0, v0, s0, T):
    """q(t) = particular + damped free motion; s(T) = e^{−γT}s0 + ∫e^{−γ(T−t)}(L + γs) dt by Gauss–Legendre."""
    D = (OMEGA**2 - NU**2) ** 2 + (GAMMA * NU) ** 2
    a, b = FORCE * (OMEGA**2 - NU**2) / D, FORCE * GAMMA * NU / D
    w, half = math.sqrt(OMEGA**2 - GAMMA**2 / 4), GAMMA / 2

    def motion(t):
        A = q0 - a
        C = (v0 - b * NU + half * A) / w
        e, cos, sin = np.exp(-half * t), np.cos(w * t), np.sin(w * t)
        q = a * np.cos(NU * t) + b * np.sin(NU * t) + e * (A * cos + C * sin)
        v = NU * (b * np.cos(NU * t) - a * np.sin(NU * t))
        v = v + e * ((C * w - half * A) * cos - (A * w + half * C) * sin)
        return q, v

    x, weights = np.polynomial.legendre.leggauss(60)
    t = 0.5 * T * (x + 1)
    q, v = motion(t)
    rate = 0.5 * v**2 - 0.5 * OMEGA**2 * q**2 + FORCE * q * np.cos(NU * t)
    s = math.exp(-GAMMA * T) * s0 + 0.5 * T * (weights * np.exp(-GAMMA * (T - t)) * rate).sum()
    return (*motion(T), s)


START = (0.7, -0.4, 0.2)


def rollout(L_d, T, steps):
    q, p, s = (torch.tensor(x, dtype=F64) for x in START)
    t = torch.arange(steps, dtype=F64)[:, None] * (T / steps)
    return Stepper(L_d).rollout(q[None], p[None], s, h=T / steps, inputs=t)


def pendulum_solution(T):
    """(q, p, s) of the driven damped pendulum, time taken along as a coordinate."""

    def field(x, y, s):
        (q, t), p = x.unbind(-1), y[..., 0]
        push = FORCE * torch.cos(NU * t)
        rate = 0.5 * p**2 - OMEGA**2 * (1 - torch.cos(q)) + q * push - GAMMA * s
        dp = -(OMEGA**2) * torch.sin(q) + push - GAMMA * p
        return torch.stack([p, torch.ones_like(t)], -1), torch.stack([dp, torch.zeros_like(t)], -1), rate

    q, p, s = (torch.tensor(x, dtype=F64) for x in START)
    zero = torch.zeros((), dtype=F64)
    x, y, s = reference_flow(field, torch.stack([q, zero]), torch.stack([p, zero]), s, T)
    return float(x[0]), float(y[0]), float(s)


def slopes(L_d, T=3.0):
    exact, errors = pendulum_solution(T) if L_d.pendulum else solution(*START, T), []
    for steps in (15, 30, 60):
        out = rollout(L_d, T, steps)
        assert bool(out.ok.all())
        last = (out.q[-1, 0], out.p[-1, 0], out.s[-1])
        errors.append([abs(float(a) - b) for a, b in zip(last, exact, strict=True)])
    return torch.log2(torch.tensor(errors[:-1]) / torch.tensor(errors[1:])), errors


@pytest.mark.parametrize("pendulum", [False, True])
def test_driven_motion_is_of_order_two(pendulum):
    # fails if a step gets the time of another step, or no time at all
    found, errors = slopes(DrivenOscillator(pendulum=pendulum))
    assert bool(((found > 1.85) & (found < 2.15)).all()), found
    assert max(errors[-1]) < 3e-3


def test_the_force_at_the_start_is_of_order_one():
    # fails if the order test above would pass whatever the time
    _, errors = slopes(DrivenOscillator(middle=False))
    worst = torch.tensor(errors).amax(-1)  # a single component's error may pass through zero
    found = torch.log2(worst[:-1] / worst[1:])
    assert bool(((found > 0.7) & (found < 1.3)).all()), found


def test_a_rollout_with_inputs_is_a_loop_over_the_steps():
    # fails if `rollout` hands the inputs on in another order
    out = rollout(DrivenOscillator(), 3.0, 15)
    q, p, s = (torch.tensor(x, dtype=F64) for x in START)
    state = State(q[None], p[None], s)
    for k in range(15):
        state = Stepper(DrivenOscillator().at(torch.tensor([0.2 * k], dtype=F64))).step(state, 0.2).state
    torch.testing.assert_close((state.q, state.p, state.s), (out.q[-1], out.p[-1], out.s[-1]), rtol=0, atol=1e-13)


@pytest.mark.parametrize("t", [0.0, 2.1])
def test_every_step_is_a_contact_map_at_its_time(t):
    # fails if the time enters p or s outside L_d
    stepper = Stepper(DrivenOscillator())
    q, p, s = (torch.tensor(x, dtype=F64) for x in START)
    c = stepper.step(State(q[None], p[None], s), 0.2, u=torch.tensor([t], dtype=F64)).c

    def flow(q, p, s):
        return stepper.step(State(q, p, s), 0.2, u=torch.tensor([t], dtype=F64)).state

    (_, p1, _), D = flow_derivative(flow, q[None], p[None], s)
    assert float(contact_defect(D, p[None], p1, c).abs().max()) < 1e-13
