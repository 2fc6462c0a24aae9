"""Fits on a GPU end as those on a CPU do, down to their equation and bands."""

import pytest
import torch

from herglotz.data import simulate
from herglotz.scenes import scene
from herglotz.training import fit
from herglotz.training.uncertainty import laplace

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch can use")


def both(**settings):
    """The same fit on a CPU and on a GPU."""
    data = simulate(scene("damped_pendulum"), trajectories=4, steps=100, h=0.1, noise=0.005, seed=0)
    return (fit(data, device=device, progress=False, **settings) for device in ("cpu", "cuda"))


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_fit_on_a_gpu_is_that_on_a_cpu(dtype):
    # fails if a part of a fit leaves the device of its data: the posterior once did, so that no default fit ended
    here, there = both(dtype=dtype)
    assert there.metrics["train_rms"] == pytest.approx(here.metrics["train_rms"], rel=1e-4)
    for ours, other in zip(there.equation().terms, here.equation().terms, strict=True):
        assert ours.what == other.what
        assert ours.value == pytest.approx(other.value, rel=1e-4)
    assert laplace(there).bands().q.shape == there.data.q.shape
    # A run is on the CPU, as what predicts and exports it is.
    assert there.stepper.rollout(*there.states_at_end(), h=0.1, steps=5).q.device.type == "cpu"


def test_networks_are_fitted_on_a_gpu():
    # fails if networks leave the device; where their flat minimum ends depends on rounding
    here, there = both(level="affine", objective="trajectory")
    assert there.metrics["train_rms"] == pytest.approx(here.metrics["train_rms"], rel=0.02)
    assert laplace(there).bands().q.shape == there.data.q.shape
