"""Searches that accelerations mislead: few samples a period, and a fast rotor under friction."""

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.noise import coarse
from herglotz.scenes import scene
from herglotz.training import FitConfig
from herglotz.training.baseline import estimate_baseline
from herglotz.training.structure import search


@pytest.mark.parametrize(("h", "noise", "expected"), [(1.0, 0.0, True), (0.5, 0.0, True), (0.5, 0.05, False)])
def test_coarse_data_are_not_taken_for_noisy_ones(h, noise, expected):
    # fails if what polynomials miss of coarse motion counts as noise, or noise as motion
    assert coarse(simulate(scene("damped_pendulum"), trajectories=3, steps=40, h=h, noise=noise, seed=0)) is expected


def test_a_linear_start_that_follows_nothing_is_not_kept():
    # fails if terms of the linear problem that miss the data by 1e7 are gone on with, or count as whole trajectories:
    # φ″ = −0.1 φ′ − 0.02 |φ′| φ′ from 12 rad/s, 201 samples 0.05 apart, noise 0.01 rad
    t = 0.05 * torch.arange(201, dtype=torch.float64)
    phi = (1 + 0.02 * 12.0 / 0.1 * (1 - torch.exp(-0.1 * t))).log() / 0.02
    phi = phi + 0.01 * torch.randn(201, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    data, _ = (
        Trajectories.of(t, phi[:, None], names=("phi",), angles=(True,))
        .unwrapped()
        .split_time(FitConfig().train_fraction)
    )
    found = search(data, estimate_baseline(data), FitConfig().resolved(data), outliers=False)
    assert found.config.drag == ("|v1| v1",)
    assert found.sigma == pytest.approx(0.01, rel=0.2)
