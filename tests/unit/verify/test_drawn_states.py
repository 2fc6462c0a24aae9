"""`verify` of an L_d alone and of a scene with its ranges, and what `simulate` and `fit` say of an L_d."""

from dataclasses import replace

import pytest
import torch

import herglotz as hz
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.verify import verify
from herglotz.verify.subject import subject
from tests.lagrangians import verlet_pendulum as pendulum


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
    if n == 1:
        assert 0.5 < float(states.p.std()) < 2.0  # fails if q1 = q0 + q̇ instead of q0 + h q̇: p is then 20 times larger
    else:
        assert float(states.p[:, 0].std()) > 100 * float(states.p[:, 1].std())


@pytest.mark.parametrize(("n", "samples", "expected"), [(10, None, 64), (32, None, 6), (32, 9, 9)])
def test_many_coordinates_are_verified_at_fewer_states(n, samples, expected):
    # fails if the default takes 64 states of any number of coordinates (32: more than 200 s), or a given number changes
    model = ContactLagrangian(ModelConfig((False,) * n, "linear", (1.0,) * n, (1.0,) * n, (1.0,) * n, (0.0,) * n))
    states = subject(model, 0.1, samples, 0).states
    assert states.q.shape == (expected, n)
    assert states.s.shape == (expected,)


def test_momenta_and_actions_belong_to_the_drawn_velocities():
    # fails if p is −FL⁻, or s0 is 0: a gauge, 50 (q1 − q0), makes p = v + 50
    states = subject(lambda q0, q1, s0, h: pendulum(q0, q1, s0, h) + 50.0 * (q1 - q0).sum(-1), 0.05, 64, 0).states
    assert 45 < float(states.p.min()) < float(states.p.max()) < 55
    assert 0.4 < float(states.s.std()) < 0.75  # uniform in [−1, 1]: 0.58


def test_a_model_alone_has_its_own_sizes():
    # fails if a learned model is verified at q of size 1 when its box is of size 1e-3, or at speeds of that size
    model = ContactLagrangian(ModelConfig(scale=(1e-3,), speed=(1e-2,)))
    states = subject(model, 0.02, 64, 0).states
    assert 3e-4 < float(states.q.std()) < 3e-3
    assert 3e-3 < float(states.p.std()) < 3e-2  # a mass of 1


def test_states_outside_L_d_are_left_out():
    # fails if a state where L_d is NaN is verified: half of all q are outside log(q), whose slope is finite there
    walled = lambda q0, q1, s0, h: ((q1 - q0) ** 2).sum(-1) / (2 * h) + h * torch.log(q0).sum(-1) - 0.02 * s0  # noqa: E731
    states = subject(walled, 0.05, 64, 0).states
    assert 20 < len(states.q) < 44
    assert all(bool(torch.isfinite(x).all()) for x in states)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: verify(pendulum), "h must be given with an L_d"),
        (
            lambda: verify(lambda q0, q1, s0, h: q0[..., 20] * q1[..., 0] + s0 * h, h=0.1),
            "up to 12 coordinates the function fails",
        ),
        (
            lambda: verify(lambda q0, q1, s0, h: torch.log(-(q0 * q1).square()).sum(-1) + s0 * h, h=0.1),
            "^L_d has no finite",
        ),
        (lambda: verify((pendulum, (1.0, 0.5, 0.0)), h=0.1), "q must be a tensor, got a float; one coordinate is q = "),
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


def test_every_coordinate_keeps_to_its_own_range():
    # fails if one coordinate's range is used for all, or low and high are exchanged with the coordinates
    shared = scene("damped_oscillator")  # isotropic: its L_d takes any n
    two = replace(shared, coordinates=("x", "y"), q_range=((0.0, 5.0), (1.0, 6.0)), v_range=((-1.0, 2.0), (-0.5, 2.5)))
    states = subject(two, None, 200, 0).states
    assert states.q.shape == (200, 2)
    for x, low, high in ((states.q, (0.0, 5.0), (1.0, 6.0)), (states.p, (-1.0, 2.0), (-0.5, 2.5))):
        for i in range(2):
            assert low[i] <= float(x[:, i].min()) < low[i] + 0.1
            assert high[i] - 0.1 < float(x[:, i].max()) <= high[i]
    assert verify(two, samples=8, steps=3).passed
