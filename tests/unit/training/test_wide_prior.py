"""The range of the prior widens where the baseline lacks a force as large as its own."""

import torch

from herglotz.data import Trajectories, simulate
from herglotz.scenes import scene
from herglotz.training import FitConfig
from herglotz.training.baseline import estimate_baseline
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.trajectory_fit import _wide_enough
from tests import runge_kutta

NOISE = 1e-3


def stiffening(count=81, h=0.1):
    """x″ = −0.15 x′ − x − 25 x³ from x = 0.4: at first the cubic spring is four times the linear one."""

    def rate(y):
        return torch.stack([y[1], -0.15 * y[1] - y[0] - 25 * y[0] ** 3])

    y, d = torch.tensor([0.4, 0.0], dtype=torch.float64), h / 20
    positions = [y[0]]
    for _ in range(count - 1):
        for _ in range(20):
            y = runge_kutta.step(rate, y, d)
        positions.append(y[0])
    noise = NOISE * torch.randn(count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    t = torch.arange(count, dtype=torch.float64) * h
    return Trajectories.of(t, (torch.stack(positions) + noise)[:, None], (count,), angles=(False,))


def widened(data, **settings):
    """By how much the range is weaker than asked for, and the error of the shortest segments."""
    config = FitConfig(level="linear", **settings)
    task = Task(data, estimate_baseline(data), config, Stages(False, None, "", resume=False))
    stages, first = _wide_enough(task, task.build("potential"), NOISE)
    assert first is not None
    return stages.task.config.departures[0] / config.departures[0], first.noise


def test_a_spring_that_stiffens_widens_the_range():
    # fails if weaker priors are not tried, or are taken for their own sake where one strength was asked for
    by, error = widened(stiffening())
    assert by > 1
    assert error < 3 * NOISE
    assert widened(stiffening(), departures=(2e-3,), iterations=3)[0] == 1


def test_a_pendulum_keeps_the_range():
    # fails if noise alone widens the range
    assert widened(simulate(scene("damped_pendulum"), trajectories=2, steps=40, h=0.1, noise=NOISE, seed=0))[0] == 1
