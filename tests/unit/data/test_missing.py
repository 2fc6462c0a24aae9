"""Positions that were not read: what stands in their place, and what reads the others."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories, as_trajectories, load, save
from herglotz.data.gaps import complete, with_missing
from herglotz.data.noise import part_of, precisions
from herglotz.data.polar import in_polar, pairs_of
from herglotz.errors import InputError

T = torch.arange(60, dtype=torch.float64) / 10


def turning(known):
    """An angle that turns and is recorded between -π and π, beside a position, with these readings (N, 2)."""
    q = torch.stack([torch.remainder(3 * T + np.pi, 2 * np.pi) - np.pi, T.sin()], 1)
    data = Trajectories.of(T, torch.where(known, q, 0.0), names=["a", "x"], angles=[True, False])
    return with_missing(data, known, str)


def test_a_reading_lost_where_an_angle_wraps_costs_no_turn():
    # fails if the value in the place of a reading lies between both ends of a jump: the jump is then none
    known = torch.ones(60, 2, dtype=torch.bool)
    known[[10, 11, 31, 52], 0] = False
    assert torch.allclose(turning(known).unwrapped().q[:, 0], 3 * T, rtol=0, atol=1e-12)


def test_two_recordings_share_no_reading():
    # fails if the first value of a recording, cut at a missing one, is that of the recording before
    known = torch.ones(60, 2, dtype=torch.bool)
    known[30, 0] = False
    data = turning(known).unwrapped()
    elsewhere = torch.where(torch.arange(60) < 30, 20.0, 0.0)
    cut = replace(data, q=data.q + elsewhere[:, None], lengths=(30, 30)).unwrapped()
    assert torch.allclose(cut.q[:, 0], 3 * T + elsewhere, rtol=0, atol=1e-12)


def test_sets_with_and_without_blanks_are_joined_saved_and_read(tmp_path):
    # fails if one file with a blank cell refuses a folder of files, or an archive forgets which cells were read
    known = torch.ones(60, 2, dtype=torch.bool)
    known[7, 1] = False
    one = turning(known).unwrapped()
    both = Trajectories.cat([replace(one, observed=None), one])
    assert both.observed is not None
    assert both.observed.sum() == 239
    save(tmp_path / "both.npz", both)
    assert load(tmp_path / "both.npz").digest() == both.digest()
    assert complete(both).lengths == (60, 59)
    save(tmp_path / "both.csv", both)
    again = load(tmp_path / "both.csv")
    assert torch.equal(again.q[both.observed > 0], both.q[both.observed > 0])
    assert again.observed is not None
    assert torch.equal(again.observed, both.observed)


@pytest.mark.parametrize("hold", ["", "first", "smooth"])
def test_a_folder_in_which_one_file_has_blanks(tmp_path, hold):
    # fails if the blank position of one file, or its row left out, refuses the folder; or if the inputs of the other
    # files keep lines between samples beside the means of steps
    rows = [f"{k / 10},{k % 7},{k % 5},{k}" for k in range(20)]
    for name, blank in (("a.csv", {}), ("b.csv", {4: "0.4,,4,4", 9: "0.9,,,9"})):
        text = "\n".join(blank.get(k, row) for k, row in enumerate(rows))
        (tmp_path / name).write_text((f"# hold: {hold}\n" if hold else "") + f"t,x,y,u\n{text}\n")
    data = load(tmp_path)
    assert data.lengths == (20, 19)
    assert data.observed is not None
    assert (data.observed == 0).nonzero().tolist() == [[24, 0]]
    assert data.hold == ("zero" if hold else "")
    assert any(f"inputs with hold {hold} are means of steps" in note for note in data.notes) == bool(hold)
    assert data.u is not None
    middle = 0.5 if hold else 0.0
    assert torch.allclose(data.u[:19, 0], torch.arange(19).double() + middle)
    assert torch.allclose(data.u[20:38, 0][9:], torch.arange(10, 19).double() + middle)


def test_noise_is_that_of_readings():
    # fails if cubics through readings count as readings: they follow the motion to a third of this noise
    noise = 1e-3 * torch.randn(2000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    t = torch.arange(2000, dtype=torch.float64) / 100
    q = torch.stack([t.sin(), t.cos()], 1) + noise
    known = torch.ones(2000, 2, dtype=torch.bool)
    known[::4, 1] = known[1::4, 0] = False
    data = with_missing(Trajectories.of(t, q), known, str)
    assert (precisions(data) * data.balance).numpy() == pytest.approx([1e-3, 1e-3], rel=0.1)


def test_a_part_of_a_long_recording_has_what_a_slow_sensor_read():
    # fails if every second row is taken, which are those that the slower sensor has not read
    t = torch.arange(4001, dtype=torch.float64) / 100
    known = torch.ones(4001, 2, dtype=torch.bool)
    known[1::2, 1] = known[2000:3000, 1] = False
    known[2001:3000:2, 1] = True  # half of it out of step
    data = with_missing(Trajectories.of(t, torch.stack([t.sin(), t.cos()], 1)), known, str)
    assert data.thinned(2).t.tolist() == t[known.all(1)][::2].tolist()
    few, rows = part_of(data, 1000)
    assert torch.equal(data.t[rows], few.t)
    assert few.observed is None
    assert 900 < few.samples < 2000


def test_an_array_keeps_what_is_beside_a_nan():  # fails if NaN in one column of an array costs the row
    x = np.column_stack([np.sin(T.numpy()), np.cos(T.numpy())])
    x[[20, 21], 0] = np.nan
    data = as_trajectories(x, h=0.1)
    assert data.samples == 60
    assert data.observed is not None
    assert data.q[20, 1] == x[20, 1]
    assert data.complete.nonzero()[:, 0].tolist() == [k for k in range(60) if k not in (20, 21)]


def test_an_angle_of_a_chain_is_where_its_own_positions_are():
    # fails if a tip that is lost costs the angle of the elbow, or interpolated positions count in a circle's fit
    a, b = 0.8 * T.cos(), (1.3 * T).sin()
    elbow = torch.stack([a.sin(), -a.cos()], 1)
    q = torch.cat([elbow, elbow + torch.stack([b.sin(), -b.cos()], 1)], 1)
    known = torch.ones(60, 4, dtype=torch.bool)
    known[20:25, 2:] = known[40:42, :2] = False
    data = with_missing(Trajectories.of(T, torch.where(known, q, 9.0), names=["x1", "y1", "x2", "y2"]), known, str)
    found = in_polar(data, pairs_of(["x1,y1", "x2,y2"])).unwrapped()
    assert found.observed is not None
    assert found.observed[20:25].tolist() == [[1.0, 0.0]] * 5
    assert found.observed[40:42].tolist() == [[0.0, 0.0]] * 2
    assert torch.allclose(found.q[found.observed > 0], torch.stack([a, b], 1)[found.observed > 0], rtol=0, atol=1e-9)
    assert torch.allclose(found.q, torch.stack([a, b], 1), rtol=0, atol=5e-3)


def test_a_weight_is_0_or_1():  # fails if a weight between them, which precisions and errors do not know, is let in
    weight = torch.ones(60, 2, dtype=torch.float64)
    weight[32, 1] = 0.5
    with pytest.raises(InputError, match=r"observed\[1\] of trajectory 1, sample 2, is 0.5; write 1 where it was read"):
        Trajectories.of(T, torch.stack([T, T], 1), [30, 30], observed=weight)
