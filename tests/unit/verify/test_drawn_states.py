"""`verify` of an L_d alone, and what `simulate` and `fit` say of one."""

import pytest
import torch

import herglotz as hz
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.verify import verify
from herglotz.verify.subject import subject


def pendulum(q0, q1, s0, h):
    v = (q1 - q0) / h[..., None]
    return h * ((v * v / 2 + torch.cos(q0)).sum(-1) - 0.2 * s0)


def coupled(q0, q1, s0, h):
    """Takes two coordinates only, with masses far from 1."""
    v = (q1 - q0) / h[..., None]
    return h * (500 * v[..., 0] ** 2 + 2 * v[..., 1] ** 2 - torch.cos(q0[..., 0] - q0[..., 1]) - 0.1 * s0)


def twenty(q0, q1, s0, h):
    return q0[..., 20] * q1[..., 0] + s0 * h


@pytest.mark.parametrize(("L_d", "n"), [(pendulum, 1), (coupled, 2)])
def test_an_L_d_alone_is_verified(L_d, n):
    # fails if momenta are drawn without regard to the masses, or the number of coordinates is not found
    report = verify(L_d, h=0.05, samples=16, steps=3)
    assert report.passed, report.table()
    states = subject(L_d, 0.05, 16, 0).states
    assert states.q.shape == (16, n)
    if n == 2:
        assert float(states.p[:, 0].std()) > 100 * float(states.p[:, 1].std())


def test_a_model_alone_has_its_own_sizes():
    # fails if a learned model is verified at q of size 1 when its box is of size 1e-3
    model = ContactLagrangian(ModelConfig(scale=(1e-3,), speed=(1e-2,)))
    states = subject(model, 0.02, 64, 0).states
    assert 3e-4 < float(states.q.std()) < 3e-3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: verify(pendulum), "h must be given with an L_d"),
        (
            lambda: verify(lambda q0, q1, s0, h: q0[..., 20] * q1[..., 0] + s0 * h, h=0.1),
            "up to 12 coordinates the function fails",
        ),
        (lambda: verify(hz.Stepper(pendulum), h=0.1), "a stepper alone has no states"),
        (
            lambda: hz.simulate(pendulum, trajectories=2, steps=5, h=0.1),  # pyright: ignore
            r"simulate takes a scene, got a function; .*Stepper\(L_d\)",
        ),
        (lambda: hz.fit(pendulum), r"a function is no recording; .*Trajectories\.of"),
    ],
)
def test_what_a_function_cannot_do_has_a_remedy(call, message):
    # fails if a newcomer with a lambda meets an AttributeError
    with pytest.raises(InputError, match=message):
        call()
