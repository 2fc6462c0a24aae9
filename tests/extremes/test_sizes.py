"""n from 1 to 256 coordinates, B from 1 to a million trajectories."""

import pytest
import torch
from extreme_cases import build, starts, state

from herglotz.stepping import State, Stepper

NEWTON = {"correction_width": 4}


def ring(n, **settings):
    return build(0.02 / n**0.5, dof=n, **settings) if n > 1 else build(0.02, **settings)


@pytest.mark.parametrize(
    ("n", "settings"),
    [(1, {}), (16, {}), (256, {}), (1, NEWTON), (8, NEWTON), (256, NEWTON)],
    ids=lambda x: str(x) if isinstance(x, int) else "newton" if x else "explicit",
)
def test_any_number_of_coordinates(n, settings):
    # fails if a shape, a solve or a network of features is written for few coordinates
    q, p, s = starts(2, dof=n)
    with torch.no_grad():
        stepper = Stepper(ring(n, **settings))
        out = stepper.rollout(q / 3, p / 3, s, h=0.1, steps=3)
        back = stepper.step(State(out.final.q, out.final.p, out.final.s), 0.1)
    assert bool(out.ok.all())
    assert bool((back.residual < 1e-12).all())
    assert float((out.q[:, 1] - out.q[:, 0] - 0.1 * p / 3).abs().max()) < 0.05


def test_coordinates_that_do_not_interact_do_not():
    # fails if the solve or the features mix coordinates: 256 equal pendulums move as one
    one, many = (build(dof=n, potential_width=0, rate=0.2) for n in (2, 256))
    with torch.no_grad():
        a = Stepper(one).rollout(*state([0.9, 0.9], [0.4, 0.4]), h=0.1, steps=20)
        b = Stepper(many).rollout(*state([0.9] * 256, [0.4] * 256), h=0.1, steps=20)
    torch.testing.assert_close(b.q, a.q[..., :1].expand_as(b.q), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    ("batch", "settings"),
    [(1, {}), (1000, {}), (1_000_000, {}), (1000, NEWTON), pytest.param(1_000_000, NEWTON, marks=pytest.mark.slow)],
    ids=lambda x: str(x) if isinstance(x, int) else "newton" if x else "explicit",
)
def test_any_number_of_trajectories(batch, settings):
    # fails if a sample depends on its batch, or memory grows by more than the states of the rollout
    stepper = Stepper(build(0.1, **{"potential_width": 4, **settings}))
    q, p, s = starts(batch)
    with torch.no_grad():
        out = stepper.rollout(q, p, s, h=0.1, steps=2)
        alone = stepper.rollout(q[-1:], p[-1:], s[-1:], h=0.1, steps=2)
    assert bool(out.ok.all())
    torch.testing.assert_close(out.q[-1:], alone.q, rtol=1e-14, atol=1e-15)
