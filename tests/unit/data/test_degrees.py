"""Angles in degrees without a word of it: converted where their motion shows it, asked for where it does not."""

import math

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories, as_trajectories, load
from herglotz.data.units import is_in_degrees
from herglotz.errors import InputError

T = np.arange(400) / 30
SWING = 2.6 * np.cos(5 * T) * np.exp(-0.05 * T)  # rad; 25 deg a sample at most
TURNING = 9 * T + 0.3 * np.sin(3 * T)  # rad; 17 deg a sample
SLOW = 2.6 * np.cos(0.2 * T)  # rad; 1 deg a sample
NOISE = 0.003 * np.random.default_rng(0).standard_normal(len(T))


def wrapped(angle, turn, low):
    return (angle - low) % turn + low


def written(folder, header, *columns):
    np.savetxt(folder / "a.csv", np.column_stack([T, *columns]), delimiter=",", header=header, comments="", fmt="%.6g")
    return folder / "a.csv"


DEGREES = {
    "a swing": np.degrees(SWING + NOISE),
    "with a spike": np.degrees(SWING + NOISE) + np.where(np.arange(400) == 77, 100, 0),
    "in steps of a degree": np.degrees(SWING).round(),
    "turning": np.degrees(TURNING + NOISE),
    "turning, from 0 to 360": wrapped(np.degrees(TURNING), 360, 0),
    "slowly, from 0 to 360": wrapped(np.degrees(SLOW + 3), 360, 180),
}
RADIANS = {
    "turning": TURNING + NOISE,
    "turning, within 4π": wrapped(TURNING, 4 * math.pi, 0),
    "within a turn": SWING,
    "turning, with a spike": TURNING + np.where(np.arange(400) == 77, 100, 0),
    "reset": np.r_[TURNING[:200], TURNING[200:] - 55],
    "counts": np.round(TURNING * 4096 / (2 * math.pi)),
    "slowly in degrees": np.degrees(SLOW),
    "at rest": np.full(400, 100.0),
}


@pytest.mark.parametrize("kind", DEGREES)
def test_motion_that_no_angle_in_radians_has(kind):  # fails if degrees without a unit are fitted as lengths
    assert is_in_degrees(Trajectories.of(T, DEGREES[kind]), torch.from_numpy(DEGREES[kind]))


@pytest.mark.parametrize("kind", RADIANS)
def test_what_may_be_radians_is_not_converted(kind):  # fails if turns in rad, jumps of several, or counts are degrees
    assert not is_in_degrees(Trajectories.of(T, RADIANS[kind]), torch.from_numpy(RADIANS[kind]))


def test_counts_without_a_unit_are_a_question(tmp_path, capsys):
    # fails if counts of an encoder are positions on a line without a word, or the answer brings the question again
    path = written(tmp_path, "t,encoder_counts", RADIANS["counts"])
    assert load(path).units == ("1",)
    told = "warning: a.csv: whole numbers without a unit, encoder_counts may be counts of an encoder: if a turn"
    assert told in capsys.readouterr().err
    found = load(path, angles="encoder_counts", sensor_scales=(2 * math.pi / 4096,))
    torch.testing.assert_close(found.q[:, 0], torch.from_numpy(TURNING), atol=1e-3, rtol=0)
    assert "warning" not in capsys.readouterr().err


def test_degrees_without_a_unit(tmp_path, capsys):
    # fails if they are converted in silence, reported in rad alone, or the user cannot say that they are none
    path = written(tmp_path, "t,pendulum_angle,x", DEGREES["a swing"], 100 * SWING)
    data = load(path)
    assert (data.names, data.units, data.degrees) == (("pendulum_angle", "x"), ("rad", "1"), ("pendulum_angle",))
    torch.testing.assert_close(data.q[:, 0], torch.from_numpy(SWING + NOISE), atol=1e-5, rtol=0)
    err = capsys.readouterr().err
    assert "pendulum_angle  angle         taken for deg, converted to rad" in err
    assert "warning: a.csv: pendulum_angle is taken for degrees: it has no unit, reaches 149, and moves" in err
    assert as_trajectories({"t": T, "theta": DEGREES["a swing"]}).degrees == ("theta",)
    assert as_trajectories(DEGREES["a swing"], h=1 / 30, coordinates="theta").units == ("rad",)
    capsys.readouterr()
    for read in (load, as_trajectories):
        none = read(path, degrees=())
        assert (none.units, none.angles) == (("1", "1"), (False, False))
    assert "warning" not in capsys.readouterr().err
    assert load(path, angles="x").units == ("1", "rad")


def test_the_same_columns_are_in_degrees_in_another_recording(tmp_path, capsys):
    # fails if a slow or short recording, which shows nothing itself, is read in other units than the fit's
    told = load(written(tmp_path, "t,theta", DEGREES["a swing"]))
    path = written(tmp_path, "t,theta", RADIANS["slowly in degrees"])
    capsys.readouterr()
    again = load(path, like=told)
    assert (again.units, again.angles, again.degrees) == (("rad",), (True,), ("theta",))
    torch.testing.assert_close(again.q[:, 0], torch.from_numpy(SLOW), atol=1e-5, rtol=0)
    assert as_trajectories({"t": T, "theta": np.degrees(SLOW)}, like=told).units == ("rad",)
    assert "warning" not in capsys.readouterr().err
    header = written(tmp_path, "t,theta[rad]", SLOW)
    torch.testing.assert_close(load(header, like=told).q[:, 0], torch.from_numpy(SLOW), atol=1e-5, rtol=0)
    length = load(written(tmp_path, "t,theta", DEGREES["a swing"]), degrees=())
    assert load(tmp_path / "a.csv", like=length).units == ("1",)


def test_where_it_is_not_certain_it_is_asked(tmp_path, capsys):
    # fails if slow degrees are converted by a guess, or the hint asks whether 149 is in rad
    path = written(tmp_path, "t,theta,x", RADIANS["slowly in degrees"], SWING)
    assert load(path).units == ("1", "1")
    err = capsys.readouterr().err
    assert "theta   coordinate    - (an angle in deg? --degrees theta)" in err
    assert "warning: a.csv: theta reaches 149 without a unit, and is taken for a length; an angle in degrees is" in err
    assert load(path, degrees="theta").degrees == ("theta",)
    assert load(path, angles="theta").degrees == ()
    with pytest.raises(InputError, match=r"degrees names 'phi', but the coordinates are theta, x"):
        load(path, degrees="phi")


def test_degrees_under_rad_are_said(tmp_path, capsys):
    # fails if a wrong unit goes without a word, is overruled, or is said of a motor that turns
    path = written(tmp_path, "t,theta[rad]", DEGREES["a swing"])
    assert load(path, unwrap=False).q.max() > 100
    why = "theta reaches 149 rad, and moves between samples as an angle in degrees: --degrees theta"
    assert f"warning: a.csv: {why}" in capsys.readouterr().err
    torch.testing.assert_close(
        load(path, degrees=["theta"]).q[:, 0], torch.from_numpy(SWING + NOISE), atol=1e-5, rtol=0
    )
    as_trajectories({"t": T, "x": DEGREES["a swing"]}, angles=True)
    assert "x reaches 149 rad" in capsys.readouterr().err
    load(written(tmp_path, "t,theta[rad]", RADIANS["turning, within 4π"]))
    once = load(written(tmp_path, "t,theta[deg]", DEGREES["a swing"]), degrees="theta")
    assert torch.equal(once.q, load(tmp_path / "a.csv").q)
    assert "warning" not in capsys.readouterr().err


def test_zeros_of_such_sensors_are_in_degrees(tmp_path):  # fails if a zero in degrees is taken off radians
    path = written(tmp_path, "t,theta", DEGREES["a swing"] + 20)
    found = load(path, sensor_zeros=[20.0], show=False)
    torch.testing.assert_close(found.q[:, 0], torch.from_numpy(SWING + NOISE), atol=1e-5, rtol=0)
