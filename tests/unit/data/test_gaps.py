"""A gap longer than all that was recorded begins another trajectory; shorter ones do not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories, as_trajectories, load
from herglotz.data.gaps import MAX_CROSSED_STEPS, parted
from herglotz.errors import InputError


def recorded(*spans):
    """Samples a second apart in these spans, (first, last)."""
    t = torch.cat([torch.arange(first, last + 1, dtype=torch.float64) for first, last in spans])
    return Trajectories.of(t, torch.sin(t))


def test_a_night_between_samples_begins_another_recording():
    # fails if a fit has to cross the night step by step, or a cut is a sample early or late
    data = parted(recorded((0, 40), (90_000, 90_030), (200_000, 200_020)))
    assert data.lengths == (41, 31, 21)
    assert data.t[41] == 90_000
    assert data.notes == ("cut into 3 trajectories at gaps of up to 1.1e+05 s",)
    assert parted(replace(data, lengths=(93,), time_unit="1", notes=())).notes[0].endswith("gaps of up to 1.1e+05")


def test_gaps_that_can_be_crossed_stay():
    # fails if any gap is cut: motion on both of its sides is one, and fixes periods best
    short = recorded((0, 40), (MAX_CROSSED_STEPS + 40, MAX_CROSSED_STEPS + 80))
    assert parted(short) is short
    assert parted(recorded((0, 40), (MAX_CROSSED_STEPS + 41, MAX_CROSSED_STEPS + 80))).lengths == (41, 40)
    long = recorded((0, 1499), (2999, 3100))  # of 1602 samples
    assert parted(long) is long
    assert parted(recorded((0, 1499), (3102, 3203))).lengths == (1500, 102)


def test_parts_too_short_are_left_out_and_said():
    # fails if one wrong time stamp is an error, or a sample goes without a word
    data = parted(recorded((0, 40), (90_000, 90_001)))
    assert data.lengths == (41,)
    assert data.notes == ("cut into 1 trajectory at gaps of up to 8.996e+04 s; 1 too short, left out",)


def test_only_the_trajectory_with_the_gap_is_cut():
    # fails if the other trajectories lose their place, or the last one's end is taken for a gap
    one, two = recorded((0, 9)), recorded((0, 9), (5000, 5009))
    assert parted(Trajectories.cat([one, two, one])).lengths == (10, 10, 10, 10)


def test_files_and_arrays_are_cut_as_they_are_read(tmp_path):
    # fails if a file, an array or a set of trajectories reaches a fit with such a gap
    data = recorded((0, 40), (90_000, 90_040))
    t, x = data.t.numpy(), data.q[:, 0].numpy()
    np.savetxt(tmp_path / "a.csv", np.c_[t, x], delimiter=",", header="t,x", comments="")
    assert load(tmp_path / "a.csv").lengths == (41, 41)
    assert as_trajectories(x, time=t).lengths == (41, 41)
    assert as_trajectories(data).lengths == (41, 41)
    assert as_trajectories({"t": t, "x": x}).lengths == (41, 41)


def test_missing_samples_of_arrays_are_left_out_and_said(capsys):
    # fails if NaN in an array is an error, shifts the times of what follows, or goes without a word
    x = np.sin(np.arange(12.0))
    x[[0, 5, 6]] = np.nan
    data = as_trajectories(x, h=0.5, inputs=np.arange(12.0))
    assert data.t.tolist() == [0.5, 1, 1.5, 2, 3.5, 4, 4.5, 5, 5.5]
    assert data.q[:, 0].tolist() == x[~np.isnan(x)].tolist()
    assert data.u is not None
    assert data.u[3] == (4 + 5 + 6) / 3
    said = "array: 3 rows are left out, without a value: the first is sample 0\n"
    assert capsys.readouterr().err == said
    assert as_trajectories([x, x], h=0.5, inputs=None).notes == data.notes
    assert capsys.readouterr().err == said + said  # each recording once
    assert as_trajectories(data).notes == data.notes
    assert capsys.readouterr().err == ""  # it has been said
    with pytest.raises(InputError, match="array: 2 of its 12 samples have a value, 3 are needed"):
        as_trajectories(np.where(np.arange(12) < 2, 1.0, np.nan), h=1)
    with pytest.raises(InputError, match="sample 3, is inf"):
        as_trajectories(np.where(np.arange(12) == 3, np.inf, np.sin(np.arange(12.0))), h=1)


def test_gaps_that_leave_no_part_are_named():
    # fails if the message is that of an empty set: it named neither the gap nor what to do
    with pytest.raises(InputError, match=r"gaps of up to 4999 .*leave no part of 3 samples; record without such gaps"):
        as_trajectories(np.sin(np.arange(3.0)), time=[0.0, 1.0, 5000.0])
