"""One driver rolls out every stepper: what it adds to `step` is the same for all of them."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Event, State, Status, StepError, Stepper
from herglotz.theory import BodyState, ConstrainedStepper, EvolutionStepper, LegendrianStepper, RigidBodyStepper
from herglotz.tune import KickStepper

H = 0.1


def pendulum(q0, q1, s0, h):
    """Damped pendulum by the trapezoidal rule, γ = 0.2."""
    c = torch.exp(-0.2 * h)
    V0, V1 = (1 - q0.cos()).sum(-1), (1 - q1.cos()).sum(-1)
    action = 0.5 * (q1 - q0).square().sum(-1) / h
    return (c - 1) * (s0 - h / 2 * V0) + c.sqrt() * action - h / 2 * (V0 + V1)


def energy(q, p, s):
    return 0.5 * p.square().sum(-1) + (1 - q.cos()).sum(-1) + 0.2 * s


def kicks():
    drifts, cosines, sines = (torch.tensor(x, dtype=torch.float64) for x in ([H / 2, H / 2], [[-H]], [[0.0]]))
    return KickStepper(H, 0.2, True, 0.0, 1.0, drifts, cosines, sines)


STEPPERS = {
    "a discrete Lagrangian": Stepper(pendulum),
    "a model, explicit": Stepper(ContactLagrangian(ModelConfig())),
    "discrete gradients": EvolutionStepper(energy, field="contact"),
    "a Legendrian relation": LegendrianStepper(pendulum, ahead=0),
    "kicks": kicks(),
}


def starts():
    q = torch.tensor([[0.3], [0.9], [-0.4]], dtype=torch.float64)
    return State(q, torch.tensor([[0.5], [0.2], [-0.8]], dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


@pytest.mark.parametrize("stepper", STEPPERS.values(), ids=STEPPERS)
def test_a_rollout_is_its_steps_one_after_another(stepper):
    # fails if the driver loses a state, σ or a status, keeps the wrong states with `every`, or cuts segments wrongly
    out = stepper.rollout(*starts(), h=H, steps=6, chunk=4)
    assert bool(out.ok.all())
    state, sigma = starts(), torch.ones(3, dtype=torch.float64)
    for k in range(7):
        # The guesses differ, so the solutions agree to the tolerance.
        found, wanted = (out.q[:, k], out.p[:, k], out.s[:, k], out.sigma[:, k]), (*state, sigma)
        torch.testing.assert_close(found, tuple(x.detach() for x in wanted), rtol=0, atol=2e-12)
        step = stepper.step(state, H)
        state, sigma = step.state, sigma * step.c
    thin = stepper.rollout(*starts(), h=H, steps=6, every=3)
    assert torch.equal(thin.q, stepper.rollout(*starts(), h=H, steps=6).q[:, ::3])
    assert thin.status.shape == (3, 2)


# Kicks know one step only; a Legendrian relation calls steps below 1e-4 SINGULAR, as rounding in c p0 + D1 L_d grows
# as 1/h, and the search for an event takes such steps.
ANY_STEP = [name for name in STEPPERS if name not in ("kicks", "a Legendrian relation")]


@pytest.mark.parametrize("name", ANY_STEP)
def test_events_stop_every_stepper(name):
    # fails if events are those of one class of steppers only, or the state at an event is no state of the stepper
    out = STEPPERS[name].rollout(*starts(), h=H, steps=12, events=[Event(lambda x: x.p[..., 0])])
    (found,) = out.events
    assert len(found.t) > 0
    assert float(found.state.p.detach().abs().max()) < 1e-12
    stopped = out.status[:, -1] == Status.STOPPED
    assert stopped.nonzero().flatten().tolist() == sorted(found.sample.flatten().tolist())


def test_inputs_and_failures_are_named_by_every_stepper():
    # fails if a stepper without inputs drops inputs, or the error of a failed step does not name the step
    with pytest.raises(InputError, match="EvolutionStepper takes no inputs"):
        STEPPERS["discrete gradients"].rollout(*starts(), h=H, inputs=torch.zeros(4, 1, dtype=torch.float64))
    steep = EvolutionStepper(lambda q, p, s: 0.5 * p.square().sum(-1) - (q**4).sum(-1) + 0 * s, field="contact")
    steep.throw = True
    with pytest.raises(StepError, match=r"step \d+: step failed at sample \(1,\): "):
        steep.rollout(10 * starts().q, starts().p, h=1.0, steps=12)


def test_a_constraint_and_a_rotation_are_driven_too():
    # fails if a stepper of other states, or with its own first guess, has a loop of its own again
    theta = torch.tensor([[0.4], [-1.0]], dtype=torch.float64)
    q = torch.cat([theta.sin(), -theta.cos()], -1)
    flat = ConstrainedStepper(
        lambda q0, q1, s0, h: 0.5 * (q1 - q0).square().sum(-1) / h - 0.2 * h * s0 - h * (q0 + q1)[..., 1] / 2,
        lambda q: q.square().sum(-1, keepdim=True) - 1,
        lambda q, p, s: p,  # noqa: ARG005
    )
    out = flat.rollout(q, 0 * q, h=0.05, steps=20, events=[Event(lambda x: x.q[..., 0])])
    assert float((out.q.square().sum(-1) - 1).abs().max()) < 1e-13
    # The motion has not reached the lowest point.
    assert len(out.events[0].t) == 0
    body = RigidBodyStepper(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), 0.1)
    start = BodyState(
        torch.eye(3, dtype=torch.float64)[None], torch.tensor([[0.3, 1.0, 0.2]]).double(), torch.zeros(1).double()
    )
    thin = body.rollout(*start, h=0.1, steps=6, every=2)
    assert torch.equal(thin.R, body.rollout(*start, h=0.1, steps=6).R[:, ::2])
