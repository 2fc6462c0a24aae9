"""Fits on a GPU end as those on a CPU do, down to their equation and bands."""

import pytest
import torch

from herglotz.data import simulate
from herglotz.scenes import scene
from herglotz.training import fit
from herglotz.training.uncertainty import laplace

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch can use")


@pytest.mark.parametrize(
    "settings",
    [{}, {"level": "affine", "objective": "trajectory"}, {"dtype": "float32"}],
    ids=["terms", "affine", "32"],
)
def test_a_fit_on_a_gpu_is_that_on_a_cpu(settings):
    # fails if a part of a fit leaves the device of its data: the posterior once did, so that no default fit ended
    data = simulate(scene("damped_pendulum"), trajectories=4, steps=100, h=0.1, noise=0.005, seed=0)
    here, there = (fit(data, device=device, progress=False, **settings) for device in ("cpu", "cuda"))
    assert there.metrics["train_rms"] == pytest.approx(here.metrics["train_rms"], rel=1e-4)
    assert there.equation() == here.equation()
    assert tuple(laplace(there).bands().q.shape) == (data.samples, 1)
