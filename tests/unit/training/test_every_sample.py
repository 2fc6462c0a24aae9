"""Fits to every m-th sample, where more tell no more."""

import math
from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, verdict
from herglotz.training.baseline import estimate_baseline
from herglotz.training.foresight import foresee
from herglotz.training.plan import Plan
from herglotz.training.stages import Stages
from herglotz.training.task import Task


def kinked(samples=1800, h=0.02):
    """x″ = −x − 0.8 sgn x − 0.05 x′, one force of which no dictionary has: exact positions, semi-implicit Euler."""
    part, x, v, out = 20, 1.3, 0.0, []
    for _ in range(samples):
        out.append(x)
        for _ in range(part):
            v += h / part * (-x - 0.8 * math.copysign(1.0, x) - 0.05 * v)
            x += h / part * v
    return Trajectories.of(
        h * torch.arange(samples, dtype=torch.float64), torch.tensor(out, dtype=torch.float64)[:, None]
    )


@pytest.fixture(scope="module")
def plan():
    """The plan of a fit to all samples of a noisy oscillation, and its data."""
    made = simulate(scene("damped_oscillator"), trajectories=2, steps=300, h=0.05, noise=1e-3, seed=0)
    run = fit(made, FitConfig(train_fraction=1.0), progress=False)
    return made, run, Plan.from_dict(run.metrics["plan"])


def test_every_fourth_sample_gives_a_motion_through_all(plan):
    # fails if samples between have no states or those of another motion, or if steps between fitted samples are long
    data, whole, of = plan
    run = fit(data, FitConfig(train_fraction=1.0), plan=replace(of, every=4, order=4), progress=False)
    assert of.every == 1
    assert run.h == pytest.approx(0.05)
    assert run.metrics["train_rms"] == pytest.approx(whole.metrics["train_rms"], rel=0.05)
    assert float((run.states.q - whole.states.q).square().mean().sqrt()) < 1e-3  # a quarter of the samples: half of σ
    assert not torch.equal(run.states.q, whole.states.q)


def test_every_fourth_sample_leaves_as_much_open(plan, monkeypatch):
    # fails if fewer samples are told with the error of all of them: deviations were twice as large, and a fit that
    # knows as much was told to need a longer recording
    data, _, of = plan
    told = []
    monkeypatch.setattr(verdict, "foresee", lambda *given: told.append(foresee(*given)) or told[-1])
    for every in (1, 4):
        fit(data, FitConfig(train_fraction=0.7), plan=replace(of, every=every, order=4), progress=False)
    all_of_them, fourth = told
    assert fourth.horizon == pytest.approx(all_of_them.horizon, rel=0.02)
    for name in ("start", "parameters"):
        assert getattr(fourth, name) == pytest.approx(getattr(all_of_them, name), rel=0.1), name  # 1 %


def test_recordings_keep_three_samples(plan):
    # fails if a plan that was made of a longer recording leaves two samples of a trajectory
    data, _, of = plan
    run = fit(data, FitConfig(train_fraction=1.0), plan=replace(of, every=200), progress=False)
    assert run.metrics["follows_data"]


def test_model_steps_are_as_long_as_those_between_samples_that_stay():
    # fails if they are cut into recorded ones again, which takes as long as all samples do
    data = kinked(60)
    task = Task(data, estimate_baseline(data), FitConfig(), Stages(False, None, "", resume=False))
    sparse = task.thinned(4)
    assert sparse.data.samples == 15
    assert (sparse.base.max_step, sparse.base.model_step) == (4 * task.base.max_step, 4 * task.base.model_step)
