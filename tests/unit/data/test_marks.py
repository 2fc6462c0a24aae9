"""Numbers that stand for a missing reading, and readings that only look like them."""

import numpy as np
import pytest

from herglotz.data import Trajectories, as_trajectories, load, save
from herglotz.errors import InputError

T = np.arange(200) * 0.02
SWING = 8 * np.cos(3 * T)
GONE = [20, 21, 22, 60, 61, 120]


def written(tmp_path, q, u=None):
    rows = zip(T, q, *([] if u is None else [u]), strict=True)
    text = "".join(",".join(f"{x:.8g}" for x in row) + "\n" for row in rows)
    (tmp_path / "a.csv").write_text(f"t[s],level[mm]{'' if u is None else ',F[N]'}\n{text}")
    return tmp_path / "a.csv"


def having(x, value, rows=GONE):
    x = x.copy()
    x[rows] = value
    return x


@pytest.mark.parametrize("mark", [-999.0, 9999.0, 1e30, -32768.0, 65535.0, -100.0, 0.0])
def test_a_mark_of_missing_readings_is_no_reading(tmp_path, mark):
    # fails if a logger's -999 is taken for a reading among millimetres, or is left out in silence
    data = load(written(tmp_path, having(SWING + (40 if mark == 0 else 0), mark)))
    assert data.samples == 200 - len(GONE)
    assert float(data.q.std()) < 8
    told = next(note for note in data.notes if "mark" in note)
    assert told.startswith(f"warning: level is {mark:.15g} in 6 rows (22, 23, 24, …), farther from its other values")


def test_marks_in_arrays(capsys):
    # fails if an array with -999 is read otherwise than a table with -999
    both = as_trajectories(np.c_[having(SWING, -999), np.sin(T)], h=0.02, coordinates=["level[mm]", "x"])
    assert both.samples == 200
    assert both.observed is not None
    assert (both.observed == 0).nonzero().tolist() == [[k, 0] for k in GONE]
    assert float(both.q.abs().max()) < 9
    assert "array: warning: level is -999 in 6 rows (20, 21, 22, …)" in capsys.readouterr().err
    assert as_trajectories(having(SWING, -999), h=0.02).samples == 200 - len(GONE)


def test_marks_in_an_archive(tmp_path, capsys):
    # fails if -999 in an archive of arrays is a reading, an input of 9999 acts, or an archive of herglotz loses numbers
    np.savez(tmp_path / "a.npz", t=T, q=np.c_[having(SWING, -999), np.sin(T)], u=having(np.sin(T), 9999, [80, 81]))
    data = load(tmp_path / "a.npz")
    assert data.samples == 200
    assert data.observed is not None
    assert data.u is not None
    assert (data.observed == 0).nonzero().tolist() == [[k, 0] for k in GONE]
    assert float(data.q.abs().max()) < 9
    assert data.u[79:82, 0].tolist() == [np.sin(T[79])] * 3
    err = capsys.readouterr().err
    assert "a.npz: warning: q1 is -999 in 6 rows (20, 21, 22, …)" in err
    assert " is 9999 in 2 rows (80, 81)" in err
    own = Trajectories.of(T, having(SWING, -999)[:, None])
    save(tmp_path / "b.npz", own)
    assert load(tmp_path / "b.npz").digest() == own.digest()


def test_two_marks_in_one_column(tmp_path):
    # fails if one mark hides another on the other side of the readings
    data = load(written(tmp_path, having(having(SWING, -999), 9999, [80, 82])))
    assert data.samples == 200 - len(GONE) - 2
    assert sum("mark" in note for note in data.notes) == 2


def test_marks_beside_blank_cells(tmp_path):
    # fails if the jump to a mark is not seen where the rows beside it are blank
    data = load(written(tmp_path, having(having(SWING, np.nan, [19, 23, 59, 62]), -999)))
    assert data.samples == 200 - len(GONE) - 4


def test_times_near_the_largest_number(tmp_path):  # fails if the difference of two times overflows with a warning
    (tmp_path / "a.csv").write_text("t,q[rad],x\n0.0,0.0,0.0\n1.7e+308,0.0,0.0\n-1.7e+308,0.0,0.0")
    with pytest.raises(InputError, match="does not increase"):
        load(tmp_path / "a.csv")


def test_a_sensor_that_is_lost_once(tmp_path):  # fails if a loggers' number has to come in two places
    assert load(written(tmp_path, having(SWING, -999, [60, 61]))).samples == 198


def test_an_input_is_held_over_its_marks(tmp_path):
    # fails if -999 N acts, or if an input keeps the mark of its logger
    data = load(written(tmp_path, SWING, having(np.sin(T), -999)))
    assert data.samples == 200
    assert data.u is not None
    assert float(data.u.abs().max()) <= 1
    assert any("F is -999 in 6 rows" in note for note in data.notes)


@pytest.mark.parametrize(
    ("q", "u"),
    [
        # A single spike, which the search for outliers leaves out.
        (having(SWING, -999, [60]), None),
        # Spikes that differ.
        (having(SWING, -999 - np.arange(6.0)), None),
        # A jump there and back, once, and to no number of loggers; readings of which few are neighbours.
        (having(SWING, -100, [60, 61]), None),
        (having(SWING, -999, np.arange(1, 199, 3)), None),
        # Not farther than the readings are from one another.
        (having(SWING, 20), None),
        # A sensor that wraps: below 0 it reads 359.9.
        (np.where(SWING > -7.98, SWING + 7.98, 359.9), None),
        # A motion that begins, or ends, at another place.
        (having(SWING, -999, np.arange(40)), None),
        (having(SWING, -999, np.arange(160, 200)), None),
        # Pulses, and levels, of inputs: 999 of a pulse width, 100 beside a sine, a motor that is switched off.
        (SWING, having(np.zeros(200), 500)),
        (SWING, having(np.arange(200) // 50 * 20.0, 999)),
        (SWING, having(np.sin(T), 100)),
        (SWING, having(1000 + np.sin(T), 0)),
    ],
)
def test_readings_stay(tmp_path, q, u):
    # fails if a reading is called a mark, though single, of other values, near the others, wrapped, or of a pulse
    data = load(written(tmp_path, q, u))
    assert data.samples == 200
    assert not any("mark" in note for note in data.notes)
    if u is not None:
        assert data.u is not None
        assert float(data.u.max()) == pytest.approx(u.max())


def test_jumps_between_recordings_are_none(tmp_path):
    # fails if the last reading of a recording and the first of the next are one jump
    readings = {"up": SWING, "off": np.full(200, -999), "down": -SWING}
    rows = [f"{name},{t:.8g},{x:.8g}\n" for name, q in readings.items() for t, x in zip(T, q, strict=True)]
    (tmp_path / "a.csv").write_text("trajectory,t[s],x[mm]\n" + "".join(rows))
    assert load(tmp_path / "a.csv").lengths == (200, 200, 200)
