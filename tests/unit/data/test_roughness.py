"""Noise without a model."""

from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, simulate
from herglotz.data.noise import DEGREES, precision, roughness
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


@pytest.mark.parametrize("still", [0, 6])
def test_one_recording_of_garbage_does_not_set_the_noise_of_all(still):
    # fails if squares of all windows are averaged, or if recordings whose sensor stands still, most of them here, say
    # that noise is an outlier
    of = torch.Generator().manual_seed(0)
    q = 0.01 * torch.randn(12, 20, generator=of, dtype=torch.float64)
    q[11] *= 100
    q[:still] = 0
    data = Trajectories.of(0.1 * torch.arange(20).double().repeat(12), q.flatten(), (20,) * 12)
    assert precision(data) == pytest.approx(0.01 * (1 - still / 11) ** 0.5, rel=0.15)


def test_fast_motion_is_no_garbage():
    # fails if a recording that polynomials of low degree alone do not follow is left out of the noise
    t = 0.1 * torch.arange(60).double()
    noise = 1e-3 * torch.randn(6, 60, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    q = torch.stack([(rate * t).sin() for rate in (1, 1.1, 1.2, 1.3, 1.4, 9.5)]) + noise
    data = Trajectories.of(t.repeat(6), q.flatten(), (60,) * 6)
    assert roughness(data.select([5]), 5) > 5 * roughness(data.select(range(5)), 5)
    assert precision(data) == min(roughness(data, degree) for degree in DEGREES)
    assert precision(data) > 1.2 * precision(data.select(range(5)))
