"""Newton, statuses, steps and rollouts."""

import pytest
import torch

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.stepping import State, Status, Stepper
from tests.lagrangians import even_model


def start(batch=3, dtype=torch.float64):
    q = torch.linspace(-1, 1, batch, dtype=dtype)[:, None]
    return State(q, torch.cos(q), torch.zeros(batch, dtype=dtype))


def test_singular_and_non_finite_statuses():
    # fails if det M = 0 or an overflow is reported as convergence
    state = start()
    flat = Stepper(lambda q0, q1, s0, h: (q0**2 + q1**2).sum(-1) / 2 + 0 * s0 * h).step(state, 0.1)
    assert set(flat.status.tolist()) == {int(Status.SINGULAR)}
    blown = Stepper(lambda q0, q1, s0, h: torch.exp(1e6 + (q1 * q0).sum(-1)) + 0 * s0 * h).step(state, 0.1)
    assert set(blown.status.tolist()) == {int(Status.DIVERGED)}


def test_rollout_with_irregular_steps():
    # fails if steps are consumed in the wrong order, s is not carried, or the guess divides by the wrong spacing
    oscillator = scene("damped_oscillator")
    h = torch.tensor([[0.1, 0.3, 0.05, 0.2, 0.2], [0.2, 0.1, 0.1, 0.3, 0.15], [0.1] * 5], dtype=torch.float64)
    out = Stepper(oscillator.L_d).rollout(*start(), h=h)
    exact = oscillator.flow(*start(), h.sum(-1))
    torch.testing.assert_close(tuple(out.final), exact, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(out.sigma[:, -1], torch.exp(-0.2 * h.sum(-1)))


def test_rest_stays_at_rest():
    # fails if the convergence test divides by the size of a motion that is zero
    q = torch.zeros(1, 1, dtype=torch.float64)
    out = Stepper(scene("damped_pendulum").L_d).rollout(q, q, q[:, 0], h=0.1, steps=5)
    assert bool(out.ok.all())
    assert float(out.q.abs().max()) == 0


@pytest.mark.parametrize("shape", [(1,), (5, 1)], ids=["alone", "batch"])
def test_a_learned_motion_comes_to_rest(shape):
    # fails if near rest, where the networks' forces are rounding, the solver asks for digits that F has not
    q = torch.linspace(1.0, 0.6, shape[0], dtype=torch.float64)[:, None] if len(shape) == 2 else torch.ones(1).double()
    with torch.no_grad():
        out = Stepper(even_model()).rollout(q, 0 * q, h=1.0, steps=150)
    assert bool(out.ok.all())
    assert float(out.q[..., -1, :].abs().max()) < 1e-15


def test_a_state_in_another_dtype_than_the_model_is_refused():
    # fails if torch's own message about dtypes, which names neither, reaches the user
    model = ContactLagrangian(ModelConfig())
    state = State(torch.ones(1), torch.ones(1), torch.tensor(0.0))
    for step in (lambda: Stepper(model).step(state, 0.1), lambda: Stepper(model).rollout(*state, h=0.1, steps=2)):
        with pytest.raises(InputError, match=r"q must be torch\.float64, as the model is, got torch\.float32"):
            step()
