"""Velocities in and out: `Stepper.init_qv` and `Stepper.velocity`."""

import math
from typing import Any

import pytest
import torch

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import reference_flow, scene
from herglotz.stepping import State, StepError, Stepper

F64 = torch.float64
K, GAMMA, B, DRAG, LAMBDA = 4.0, 0.3, 0.2, 0.1, 0.15


def pendulum(**settings) -> Any:
    """A pendulum of stiffness K and damping GAMMA."""
    given = {"level": "linear", "potential_width": 0, "rate": GAMMA, "damping_width": 0} | settings
    return ContactLagrangian(ModelConfig((True,), stiffness=(K,), **given)).requires_grad_(False)


def rubbing() -> Any:
    """The same with viscous friction and drag of the square of the velocity."""
    model = pendulum(level="forced", drag=("|v1| v1",))
    model.friction.viscous.fill_(B)
    model.drag.coefficient.fill_(DRAG)
    return model


def sticking(breakaway=0.0) -> Any:
    """The same with dry friction that can hold it. Stribeck's term makes its steps, and so v, of order 1."""
    model = pendulum(level="forced", coulomb=True, sticking=True)
    model.friction.coulomb.fill_(0.8)
    model.friction.breakaway.fill_(breakaway)
    return model


def falling() -> Any:
    """Damping by the way that is gone, as a parachute has it: p = v + λ s is no velocity."""
    model = pendulum(level="affine")
    model.damping.drag.fill_(LAMBDA)
    return model


def coupled() -> Any:
    """Two lengths whose kinetic term is q1 (v1² + v1 v2), which K's features give: the mass depends on the position."""
    ones = (1.0, 1.0)
    model: Any = ContactLagrangian(
        ModelConfig((False, False), "linear", ones, ones, ones, (0.0, 0.0), potential_width=0,
                    features=("q1 v1^2", "q1 v1 v2"))
    ).requires_grad_(False)  # fmt: skip
    model.kinetic.sum.coefficient.fill_(0.2)
    return model


def free(q, v, s):
    return v, -K * q.sin() - GAMMA * v, 0 * s


def with_drag(q, v, s):
    return v, free(q, v, s)[1] - B * v - DRAG * v.abs() * v, 0 * s


def with_dry(q, v, s):
    return v, free(q, v, s)[1] - 0.8 * v.sign(), 0 * s


def along_the_way(q, v, s):
    """Herglotz' equation of L = v²/2 − V + (λv − γ)s: d/dt (v + λs) + V′ = (λv − γ)(v + λs), ṡ = L."""
    action = s[..., None]
    L = v * v / 2 - K * (1 - q.cos()) + (LAMBDA * v - GAMMA) * action
    return v, (LAMBDA * v - GAMMA) * (v + LAMBDA * action) - K * q.sin() - LAMBDA * L, L[..., 0]


def one(x):
    return torch.tensor([x], dtype=F64)


@pytest.mark.parametrize(
    ("model", "motion", "order"),
    [(rubbing(), with_drag, 2), (sticking(), with_dry, 2), (falling(), along_the_way, 2), (pendulum(order=4), free, 4)],
    ids=["drag", "sticking", "affine", "order 4"],
)
def test_a_velocity_has_the_order_of_the_integrator(model, motion, order):
    # fails if p stands for the velocity, if half an impulse of dry friction is left in it, if what depends on s is not
    # taken off, or if a start at a velocity is one at a momentum. Errors at h over those at h/2, 4.0 and 16 measured.
    stepper, start, t, errors = Stepper(model), (one(0.3), one(2.5), torch.tensor(0.4, dtype=F64)), 0.4, []
    q, v, _ = reference_flow(motion, *start, t)
    for steps in (8, 16):
        h = t / steps
        out = stepper.rollout(*stepper.init_qv(*start, h), h=h, steps=steps)
        found = stepper.velocity(out.final, h)
        errors.append((float((out.final.q - q).abs()), float((found - v).abs())))
    for coarse, fine in zip(*errors, strict=True):
        assert coarse / fine == pytest.approx(2.0**order, rel=0.15)


@pytest.mark.parametrize("name", ["parachute", "duffing", "van_der_pol", "double_pendulum"])
def test_any_L_d_has_velocities_of_order_2(name):
    # fails if s is that of the start of the step, not of its middle, or a single transform replaces the mean
    true = scene(name)
    stepper, errors = Stepper(true.L_d), []
    make = torch.Generator().manual_seed(1)
    q, v = (0.5 * torch.randn(4, true.dof, generator=make, dtype=F64) for _ in range(2))
    s = 0.3 * torch.randn(4, generator=make, dtype=F64)
    for h in (true.h / 2, true.h / 4):
        state = stepper.init_qv(q, v, s, h)
        errors.append(float((state.p - true.momentum(q, v, s)).abs().max()))
        torch.testing.assert_close(stepper.velocity(state, h), v, rtol=1e-10, atol=1e-10)
    assert errors[1] < 1e-10 or errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)


def test_a_velocity_is_the_slope_of_the_motion_of_coupled_coordinates():
    # fails if L_vv or the mass is that of q = 0
    stepper = Stepper(coupled())
    q, v = torch.tensor([[0.5, -0.2]], dtype=F64), torch.tensor([[0.7, -1.1]], dtype=F64)
    h = 1e-4
    state = stepper.init_qv(q, v, None, h)
    assert float((state.p - v).abs().min()) > 0.02
    move = (stepper.step(state, h).state.q - q) / h
    later = stepper.velocity(stepper.step(state, h).state, h)
    torch.testing.assert_close(move, (v + later) / 2, rtol=0, atol=1e-7)
    torch.testing.assert_close(stepper.velocity(state, h), v, rtol=1e-14, atol=1e-14)


def test_the_inverse_with_friction_is_exact():
    # fails if the inclusion has another friction force than the start, or lacks Stribeck's slope
    stepper, v = Stepper(sticking(0.4)), torch.linspace(-1.0, 1.0, 21, dtype=F64)[:, None]
    state = stepper.init_qv(0 * v + 0.3, v, None, 0.1)
    assert float((state.p - v).abs().max()) > 0.03
    torch.testing.assert_close(stepper.velocity(state, 0.1), v, rtol=1e-13, atol=1e-13)


def test_what_friction_holds_stands_still():
    # fails if a joint that sticks has the velocity of its momentum, or a joint that slides stops
    stepper, h = Stepper(sticking(0.4)), 0.05
    out = stepper.rollout(*stepper.init_qv(one(0.2), one(0.3), None, h), h=h, steps=40)
    v = stepper.velocity(out.states, h)[:, 0]
    still = out.q.diff(dim=0)[:, 0] == 0
    assert 0 < int(still.sum()) < 39
    assert float(v[1:][still].abs().max()) == 0.0
    assert bool((v[:-1][~still] != 0).all())
    assert float(out.p[-1].abs()) > 0.01


def test_batches_floats_and_slopes():
    # fails if a sample depends on another sample, float32 overflows in 1/h², or the slope is that of the iteration
    stepper, make = Stepper(falling()), torch.Generator().manual_seed(0)
    q, v = (torch.randn(3, 5, 1, generator=make, dtype=F64) for _ in range(2))
    s = torch.randn(3, 5, generator=make, dtype=F64)
    h = 0.1 + torch.rand(3, 5, generator=make, dtype=F64)
    state = stepper.init_qv(q, v, s, h)
    torch.testing.assert_close(state.p, v + LAMBDA * s[..., None], rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(stepper.velocity(state, h), v, rtol=1e-14, atol=1e-14)
    single = Stepper(falling().float())
    low = State(*(x.float() for x in state))
    torch.testing.assert_close(single.velocity(low, 0.1), v.float(), rtol=1e-5, atol=1e-6)
    p = state.p.requires_grad_()
    slope = torch.autograd.grad(stepper.velocity(State(q, p, s), h).sum(), p)[0]
    torch.testing.assert_close(slope, torch.ones_like(p), rtol=1e-12, atol=1e-12)


def test_a_momentum_without_a_velocity_is_said():
    # fails if NaN or the last iterate leaves in silence: |L_v| < 1 of L = √(1 + v²), a body at the speed of light
    def relativistic(q0, q1, s0, h):
        v = (q1 - q0) / h[..., None] if h.ndim else (q1 - q0) / h
        return h * (1 + v.square()).sqrt().sum(-1) + 0 * s0

    stepper = Stepper(relativistic)
    q, s = torch.zeros(2, 1, dtype=F64), torch.zeros(2, dtype=F64)
    p = torch.tensor([[0.6], [1.5]], dtype=F64)
    assert float(stepper.velocity(State(q[:1], p[:1], s[:1]), 0.1)) == pytest.approx(0.75)
    with pytest.raises(StepError, match=r"no velocity at sample \(1,\)"):
        stepper.velocity(State(q, p, s), 0.1)
    with pytest.raises(InputError, match="p must be finite"):
        stepper.velocity(State(q, p * math.nan, s), 0.1)
    with pytest.raises(InputError, match="h must be > 0"):
        stepper.init_qv(q, p, s, 0.0)
