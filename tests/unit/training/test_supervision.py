"""Recorded s and p in the one-step objective: exact derivatives, their unit, and the full level made reliable."""

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import reference_solve, scene
from herglotz.training import FitConfig, Prior, fit
from herglotz.training.problems.one_step import SupervisedProblem
from tests.compared import assert_gradient


def pendulum(unit=1.0, **settings):
    """Exact motion with s and p, in the unit of a bob of mass `unit`."""
    data = simulate(scene("damped_pendulum"), keep_state=True, **settings)
    assert data.s is not None
    assert data.p is not None
    return Trajectories.of(
        data.t, data.q, data.lengths, names=data.names, angles=data.angles, s=unit * data.s, p=unit * data.p
    )


def damped_by_s(count=24, steps=14, h=0.1):
    """Many short motions whose damping 0.4 + 0.3 tanh s depends on s: (q, v) cannot stand in for it."""

    def field(q, p, s):
        damping = (0.4 + 0.3 * torch.tanh(s))[..., None]
        R = -0.4 * s - 0.3 * torch.log(torch.cosh(s))
        return p, -torch.sin(q) - damping * p, (p * p / 2 + torch.cos(q) - 1)[..., 0] + R

    make = torch.Generator().manual_seed(0)
    draw = lambda *shape: 2 * torch.rand(*shape, generator=make, dtype=torch.float64) - 1  # noqa: E731
    state = 1.2 * draw(count, 1), draw(count, 1), 3 * draw(count)
    states = [state]
    for _ in range(steps):
        x = reference_solve(field, *states[-1], h)
        states.append((x.q1, x.p1, x.s1))
    q, p, s = (torch.stack(x, 1).flatten(0, 1) for x in zip(*states, strict=True))
    t = (torch.arange(steps + 1, dtype=torch.float64) * h).repeat(count)
    return Trajectories.of(t, q, (steps + 1,) * count, angles=(True,), s=s, p=p)


@pytest.mark.parametrize(
    ("level", "momenta", "freedom"), [("linear", False, 4.0), ("affine", True, None), ("full", True, 4.0)]
)
def test_gradients_match_finite_differences(level, momenta, freedom):
    # fails if a residual lacks its derivative by a parameter or by the unit
    data = pendulum(2.0, trajectories=3, steps=12, h=0.2, seed=4, gaps=1)
    model = ContactLagrangian(ModelConfig(level=level, rate=0.2, stiffness=(1.0,)))
    make = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in model.parameters():
            p += 0.1 * torch.randn(p.shape, generator=make, dtype=p.dtype)
    prior = Prior(model, data.q.amin(0), data.q.amax(0), departure=0.1)
    problem = SupervisedProblem(model, data, momenta=momenta, sigma=0.1, prior=prior, freedom=freedom, chunk=10)
    assert_gradient(problem, problem.start(), 2e-5, make)


@pytest.mark.parametrize("supervision", ["qs", "qps"])
def test_the_unit_of_s_is_found(supervision):
    # fails if s and p are taken in the model's unit, in which the first mass is 1
    data = pendulum(2.5, trajectories=6, steps=30, h=0.2, seed=1)
    run = fit(data, FitConfig(supervision=supervision, iterations=30, correction_width=6), progress=False)
    assert run.metrics["objective"] == "residual"
    assert run.metrics["unit_of_s"] == pytest.approx(2.5, rel=5e-3)
    assert run.metrics["rate"] == pytest.approx(0.2, abs=2e-3)
    assert run.metrics["extrapolation_rms"] < 3e-3


@pytest.mark.slow
def test_the_full_level_is_reliable_with_s():
    # fails if recorded s do not reach the steps, the start states or the free run
    data = damped_by_s()
    errors = {}
    for level, supervision in (("affine", "q"), ("full", "qs")):
        settings = FitConfig(
            level=level, supervision=supervision, objective="residual", iterations=40, correction_width=0,
            action_width=6,
        )  # fmt: skip
        errors[level] = fit(data, settings, progress=False).metrics["extrapolation_rms"]
    assert errors["full"] < 0.3 * errors["affine"], errors


def test_what_is_not_recorded_is_named():
    # fails if a fit without s falls back on positions without a word, or with an objective that ignores s
    data = simulate(scene("damped_pendulum"), trajectories=2, steps=12, h=0.2)
    with pytest.raises(InputError, match="supervision by s needs s at every sample; record it or set supervision='q'"):
        fit(data, FitConfig(supervision="qs"))
    with pytest.raises(InputError, match="one-step objective; set objective='residual', not 'trajectory'"):
        FitConfig(supervision="qs", objective="trajectory")
