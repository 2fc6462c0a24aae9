"""Noise without a model."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.noise import roughness
from herglotz.scenes import scene


@pytest.mark.parametrize("gaps", [0, 3])
def test_noise_is_found_and_motion_is_not_taken_for_it(gaps):
    # fails if the degrees of freedom are counted wrongly, windows cross trajectories, or steps are taken for equal
    clean = simulate(scene("damped_pendulum"), trajectories=10, steps=60, h=0.1, gaps=gaps, seed=0)
    assert roughness(clean) < 1e-4
    noise = torch.randn(clean.q.shape, generator=torch.Generator().manual_seed(0), dtype=clean.q.dtype)
    assert roughness(replace(clean, q=clean.q + 0.01 * noise)) == pytest.approx(0.01, rel=0.1)


def test_too_few_samples_say_nothing():
    # fails if short trajectories are joined
    t = torch.arange(8, dtype=torch.float64).repeat(2)
    assert roughness(Trajectories.of(t, torch.rand(16, 1, dtype=torch.float64), (8, 8))) == float("inf")
