"""The measured sets, where the folder is there: counts, gaps and splits."""

from pathlib import Path

import numpy as np
import pytest
import torch

from herglotz.data import load, read_csv

SHARED = Path(__file__).parents[3] / "../shared/data"
pytestmark = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no measured data in {SHARED}")


def test_real_pendulum():  # fails if a row is lost, gaps are closed up, or v is read for the angle
    data = load(SHARED / "schmidt_lipson_2009/real_pend_h_1.txt")
    assert (len(data), data.samples, data.names, data.angles) == (1, 556, ("theta",), (True,))
    assert (data.t[0].item(), data.t[-1].item()) == (5.0, 99.5)
    sizes = (6 * data.steps().h).round().long()
    assert torch.bincount(sizes).tolist() == [0, 545, 8, 2]
    assert data.typical_step == pytest.approx(1 / 6)
    assert data.gaps == 10
    # two windows touch each of the 10 gaps, unless a gap follows a gap
    usual = data.triples(0.2)
    assert len(data.triples()) == 554
    assert len(usual) == int(((sizes[1:] == 1) & (sizes[:-1] == 1)).sum()) == 534
    assert usual.h0.max() < 0.17
    assert usual.h1.max() < 0.17
    train, test = data.split_time(2 / 3)
    assert (train.samples, test.samples) == (371, 185)
    assert train.t[-1] < test.t[0]


def test_real_air_track():  # fails if pixels are unwrapped as angles
    data = load(SHARED / "schmidt_lipson_2009/real_linear_h_1.txt")
    assert (data.samples, data.names, data.units, data.angles) == (870, ("x",), ("pixel",), (False,))
    assert torch.equal(data.q, data.q.round())
    assert data.q.abs().max() == 102
    assert data.gaps == 0


@pytest.mark.parametrize(
    ("name", "samples", "gaps"), [("energy_shaping", 4000, 0), ("pd__system_identification", 1170, 0), ("sac", 8000, 1)]
)
def test_dfki_pendulum(name, samples, gaps):  # fails if velocity is a coordinate, or torque is not an input
    path = SHARED / f"dfki_pendulum/control_method_{name}__data_measured.csv"
    data = read_csv(path).with_angles("position")
    assert (data.samples, data.names, data.angles, data.units) == (samples, ("position",), (True,), ("rad",))
    assert data.gaps == gaps
    raw = np.loadtxt(path, delimiter=",", skiprows=1)
    assert data.u is not None
    assert np.array_equal(data.u[:, 0].numpy(), raw[:, 3])
    assert np.array_equal(data.q[:, 0].numpy(), raw[:, 1])
    assert torch.equal(load(path, angles="position").q, data.q)  # this encoder already counts turns
    assert read_csv(path).angles == (False,)  # the file gives no unit, so it must be said
