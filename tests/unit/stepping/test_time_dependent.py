"""Time-dependent L_d through `L_d.at(t)`: a driven damped pendulum against its reference flow."""

import pytest
import torch

from herglotz.mechanics import contact_defect, flow_derivative
from herglotz.scenes import reference_flow
from herglotz.stepping import State, Stepper

OMEGA, GAMMA, FORCE, NU = 1.3, 0.4, 0.9, 1.7
F64 = torch.float64


class DrivenPendulum:
    """L = v²/2 − Ω²(1 − cos q) + f q cos νt − γs by the midpoint, Heun's s; the input is the start time of a step."""

    def __init__(self, middle=True):
        # False: the force at the start of the step, a rule of order 1.
        self.middle = middle

    def __call__(self, q0, q1, s0, h):
        return self.at(torch.zeros_like(q0))(q0, q1, s0, h)

    def at(self, u):
        def L_d(q0, q1, s0, h):
            t = u[..., 0] + (0.5 * h if self.middle else 0.0)
            q, v = 0.5 * (q0 + q1)[..., 0], (q1 - q0)[..., 0] / h

            def L(s):
                return 0.5 * v**2 - OMEGA**2 * (1 - torch.cos(q)) + FORCE * q * torch.cos(NU * t) - GAMMA * s

            return h * L(s0 + 0.5 * h * L(s0))

        return L_d


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
    """The order of q, p and s between 15, 30 and 60 steps, and the largest errors of each."""
    exact, errors = torch.tensor(pendulum_solution(T)), []
    for steps in (15, 30, 60):
        out = rollout(L_d, T, steps)
        assert bool(out.ok.all())
        errors.append((torch.stack([out.q[-1, 0], out.p[-1, 0], out.s[-1]]) - exact).abs())
    return torch.stack(errors).log2().diff(dim=0).neg(), torch.stack(errors)


def test_driven_motion_is_of_order_two():
    # fails if a step gets the time of another step, or no time at all
    found, errors = slopes(DrivenPendulum())
    assert bool(((found > 1.85) & (found < 2.15)).all()), found
    assert float(errors[-1].max()) < 3e-3


def test_the_force_at_the_start_is_of_order_one():
    # fails if the order test above would pass whatever the time
    found, _ = slopes(DrivenPendulum(middle=False))
    assert bool(((found.amin(-1) > 0.7) & (found.amin(-1) < 1.3)).all()), found


@pytest.mark.parametrize("t", [0.0, 2.1])
def test_every_step_is_a_contact_map_at_its_time(t):
    # fails if the time enters p or s outside L_d
    stepper = Stepper(DrivenPendulum())
    q, p, s = (torch.tensor(x, dtype=F64) for x in START)
    c = stepper.step(State(q[None], p[None], s), 0.2, u=torch.tensor([t], dtype=F64)).c

    def flow(q, p, s):
        return stepper.step(State(q, p, s), 0.2, u=torch.tensor([t], dtype=F64)).state

    (_, p1, _), D = flow_derivative(flow, q[None], p[None], s)
    assert float(contact_defect(D, p[None], p1, c).abs().max()) < 1e-13
