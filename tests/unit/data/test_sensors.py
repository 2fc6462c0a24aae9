"""Sensor maps: q = scale · (reading − zero), from arguments, flags and comments of a file."""

import math
from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, as_trajectories, load, save
from herglotz.data.sensors import measured
from herglotz.errors import InputError


def two_recordings() -> Trajectories:
    """Two recordings of two coordinates, five and four samples."""
    t = torch.cat([torch.arange(5), torch.arange(4)]).double()
    q = torch.linspace(0, 1, 18, dtype=torch.float64).reshape(9, 2)
    return Trajectories.of(t, q, (5, 4), names=("theta", "x"), units=("rad", "m"), angles=(True, False))


def test_each_recording_has_its_zeros_and_all_have_one_scale():
    data = two_recordings()
    found = measured(replace(data, v=data.q), (0.1, -0.2, 0.3, 0.5), (2.0, -1.0))
    zero = torch.tensor([[0.1, -0.2]] * 5 + [[0.3, 0.5]] * 4, dtype=torch.float64)
    scale = torch.tensor([2.0, -1.0], dtype=torch.float64)
    # fails if the zeros of one recording go to the other, a zero is subtracted after the scale, or rates keep theirs
    assert torch.equal(found.q, scale * (data.q - zero))
    assert found.v is not None
    assert torch.equal(found.v, scale * data.q)


def test_one_zero_a_coordinate_is_that_of_all_recordings():
    data = two_recordings()
    assert torch.equal(measured(data, (0.1, -0.2)).q, data.q - torch.tensor([0.1, -0.2], dtype=torch.float64))


@pytest.mark.parametrize(
    ("zeros", "scales", "said"),
    [
        ((0.1,), (), "sensor zeros: give 2, one for each of theta, x, or 4, those of its 2 recordings"),
        ((0.1, math.nan), (), "sensor zeros must be finite numbers, got nan"),
        ((), (1.0, 0.0), "a scale of 0 leaves no motion"),
    ],
)
def test_what_makes_no_sense_is_refused(zeros, scales, said):
    with pytest.raises(InputError, match=said.replace("(", r"\(")):
        measured(two_recordings(), zeros, scales)


def test_a_zero_that_drifts_begins_with_its_recording():
    # fails if a drift goes on from one recording to the next, or velocities keep it
    data = two_recordings()
    still = measured(replace(data, v=data.q), drifts=(0.1, -1.0))
    t = torch.tensor([0.0, 1, 2, 3, 4, 0, 1, 2, 3], dtype=torch.float64)[:, None]
    rate = torch.tensor([0.1, -1.0], dtype=torch.float64)
    assert torch.equal(still.q, data.q - t * rate)
    assert still.v is not None
    assert torch.equal(still.v, data.q - rate)


CSV = "# zero: {zero}\n# scale: 1, 0.5\nt[s],theta[{unit}],x[m]\n0,1,1\n1,2,2\n2,3,4\n"


@pytest.mark.parametrize(("unit", "by"), [("rad", 1.0), ("deg", math.pi / 180)])
def test_a_file_says_what_its_sensors_read_in_its_own_units(tmp_path, unit, by):
    path = tmp_path / "a.csv"
    path.write_text(CSV.format(unit=unit, zero="1 -1"))
    found = load(path, show=False, unwrap=False).q
    expected = torch.tensor([[0.0, 1.0], [by, 1.5], [2 * by, 2.5]], dtype=torch.float64)
    # fails if a zero in degrees is subtracted from radians, or the comments are skipped
    assert torch.allclose(found, expected, rtol=1e-15, atol=1e-15)
    path.write_text(CSV.format(unit=unit, zero="0 0").replace("1, 0.5", "1 1"))
    asked = as_trajectories(path, sensor_zeros=(1, -1), sensor_scales=(1, 0.5)).q
    assert torch.allclose(asked, expected, rtol=1e-15, atol=1e-15)


def test_a_corrected_recording_is_written_without_its_comment(tmp_path):
    path, again = tmp_path / "a.csv", tmp_path / "b.csv"
    path.write_text(CSV.format(unit="rad", zero="1 -1"))
    once = load(path, show=False)
    save(again, once)
    assert torch.equal(load(again, show=False).q, once.q)  # fails if the map is applied a second time


def test_a_scale_comes_before_angles_are_unwrapped(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t[s],theta[rad]\n0,0\n1,10\n2,20\n3,30\n")  # counts of 0.1 rad: steps of 1 rad
    found = load(path, show=False, sensor_scales=(0.1,)).q[:, 0]
    assert torch.allclose(found, torch.tensor([0.0, 1.0, 2.0, 3.0], dtype=torch.float64))


def test_a_comment_that_is_no_number_is_refused_with_its_place(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(CSV.format(unit="rad", zero="ten -1"))
    with pytest.raises(InputError, match=r"a.csv, comment '# zero: ten -1': 'ten' is not a number"):
        load(path, show=False)


def test_zeros_that_a_fit_has_found_are_in_rad(tmp_path):
    # fails if they are taken for degrees where the table has degrees: 0.05 rad of a zero were 0.0009 rad, and three
    # recordings of a pendulum that differ by them did not fit
    path = tmp_path / "a.csv"
    path.write_text("t[s],theta[deg]\n0,10\n1,20\n2,30\n")
    data = load(path, show=False)
    assert torch.equal(measured(data, (0.05,)).q, data.q - 0.05)
