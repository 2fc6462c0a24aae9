"""Two rates in one table: what is known between samples of an input, and which rows are samples of the motion."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from herglotz.cli import main
from herglotz.data import as_trajectories, load, read_csv
from herglotz.errors import InputError
from herglotz.training.missed import reason_of_data

T = np.arange(40) * 0.1  # of the positions
X = np.sin(3 * T)
CLOCK = np.arange(17) * 0.27 - 0.05  # of the inputs, which start before the positions and end behind them
U = np.cos(5 * np.arange(17.0))


def union(*parts):
    """Rows of one time each, columns t, x, u, where `parts` are (times, x, u) with None for nothing."""
    rows = [np.column_stack([t, *(np.full(len(t), np.nan) if x is None else x for x in more)]) for t, *more in parts]
    return np.concatenate(rows)


def merged():
    both = union((T, X, None), (CLOCK, None, U))
    return both[np.argsort(both[:, 0])]


def written(folder, rows, header="t[s],x[m],u[N]", before=""):
    text = "\n".join(",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in rows)
    (folder / "a.csv").write_text(f"{before}{header}\n{text}\n")
    return folder / "a.csv"


def mean_held(straight):
    """The mean input of each step of the positions, by brute force."""
    found = []
    for one, two in pairwise(T):
        t = one + (np.arange(4000) + 0.5) / 4000 * (two - one)
        found.append((np.interp(t, CLOCK, U) if straight else U[np.searchsorted(CLOCK, t, side="right") - 1]).mean())
    return np.array(found)


@pytest.mark.parametrize(
    ("told", "comment", "straight"),
    [
        ({}, "", False),
        ({"hold": "zero"}, "# hold: first\n", False),
        ({"hold": "first"}, "", True),
        ({}, "# hold: first\n", True),
    ],
)
def test_inputs_at_their_own_times(tmp_path, capsys, told, comment, straight):
    # fails if the rows without positions are lost for the inputs, a step has the input of its first row instead of the
    # mean over it, the file's word stands over the user's, or the means are taken for values at the samples
    data = load(written(tmp_path, merged(), before=comment), **told)
    assert (data.t.tolist(), data.q[:, 0].tolist()) == (T.tolist(), X.tolist())
    assert data.u is not None
    assert data.u[:-1, 0].numpy() == pytest.approx(mean_held(straight), abs=2e-4)
    assert data.hold == "zero"
    err = capsys.readouterr().err
    assert f"  16 rows are left out, without a value: the first is row {3 if comment else 2}, column 'x'" in err
    assert ("warning: a.csv: u has no value in some rows: the last one is held, for up to 0.26 s" in err) != straight
    assert ("u has no value in some rows; straight lines go there" in err) == straight


def test_blanks_are_filled_as_in_another_recording(tmp_path):
    # fails if the hold of a recording does not fill the blanks of the next, in a file, a folder or a frame, or comes
    # before the hold of the file or of the user, or if a hold that is stated has a remedy
    both = merged()
    file = written(tmp_path, both)
    folder = tmp_path / "folder"
    folder.mkdir()
    written(folder, both)
    frame = {"t[s]": both[:, 0], "x[m]": both[:, 1], "u[N]": both[:, 2]}
    straight = mean_held(True)
    known = replace(load(file, hold="first", show=False), hold="first")
    for source in (file, folder, frame):
        found = as_trajectories(source, like=known)
        assert found.u is not None
        assert found.u[:-1, 0].numpy() == pytest.approx(straight, abs=2e-4)
    constant = load(file, like=known, hold="zero", show=False)
    assert constant.u is not None
    assert constant.u[:-1, 0].numpy() == pytest.approx(mean_held(False), abs=2e-4)
    assert constant.notes[0].endswith("the last one is held, for up to 0.26 s")
    open_hold = load(file, show=False)
    assert "; a fit with --hold first (hold= in Python) draws straight lines" in open_hold.notes[0]
    stated = load(written(tmp_path, both, before="# hold: zero\n"), like=known, show=False)
    assert stated.u is not None
    assert stated.u.tolist() == constant.u.tolist()


def test_positions_that_are_slower_than_an_input(tmp_path):
    # fails if it is not said that the input within a step is lost, at reading and beside the verdict of a misfit
    for every, said in ((5, True), (0, False)):
        rows = ((k / 100, k / 7 if every == 0 or k % every == 0 else np.nan, k % 3) for k in range(101))
        data = load(written(tmp_path, rows), show=False)
        assert any(note.endswith("; most steps have the mean of their inputs") for note in data.notes) is said
        assert reason_of_data(data).startswith("Inputs were recorded more often than the motion: most steps") is said


def test_a_slow_input_beside_every_position(tmp_path):
    # fails if an input that is written at every fourth row is refused, or its hold is open though it is known
    u = np.where(np.arange(40) % 4 == 0, np.repeat(U[:10], 4), np.nan)
    data = load(written(tmp_path, union((T, X, u))), show=False)
    assert data.u is not None
    assert (data.u[:, 0].tolist(), data.hold) == (np.repeat(U[:10], 4).tolist(), "zero")
    lines = load(written(tmp_path, union((T, X, u))), hold="first", show=False)
    assert lines.hold == "first"
    assert lines.u is not None
    assert lines.samples == 37  # nothing is known behind the last input
    assert lines.u[:, 0].numpy() == pytest.approx(np.interp(T[:37], T[::4], U[:10]))


def test_a_blank_among_inputs_of_every_row(tmp_path):
    # fails if one value that was not logged settles what all inputs do between samples, or costs a sample
    u = np.cos(T)
    u[7] = np.nan
    data = load(written(tmp_path, union((T, X, u))), show=False)
    assert data.u is not None
    assert (data.samples, data.hold, float(data.u[7, 0])) == (40, "", float(np.cos(T[6])))


def test_inputs_are_not_known_before_their_first_and_long_after_their_last(tmp_path):
    # fails if an input is made up: at the start, or when its log has ended
    u = np.where((np.arange(40) >= 5) & (np.arange(40) < 25), np.cos(T), np.nan)
    data = load(written(tmp_path, union((T, X, u))), show=False)
    assert data.t.tolist() == T[5:26].tolist()


def test_recordings_are_filled_apart(tmp_path):  # fails if the last input of one recording starts the next
    rows = np.column_stack([np.repeat([0, 1], 20), np.tile(T[:20], 2), X, np.cos(np.arange(40))])
    rows[20:23, 3] = np.nan
    data = load(written(tmp_path, rows, "run,t[s],x[m],u[N]"), show=False)
    assert data.lengths == (20, 17)
    assert data.t[20] == T[3]


def test_stacked_tables_and_rows_of_one_time(tmp_path):
    # fails if tables that were put one below the other, or joined by time, are refused for their times
    stacked = union((T, X, None), (T[::3], None, np.cos(T[::3])))
    expected = load(written(tmp_path, union((T, X, np.where(np.arange(40) % 3 == 0, np.cos(T), np.nan)))), show=False)
    for rows in (
        stacked,
        stacked[np.argsort(stacked[:, 0], kind="stable")],
        stacked[::-1][np.argsort(stacked[::-1, 0])],
    ):
        data = load(written(tmp_path, rows), show=False)
        assert data.u is not None
        assert expected.u is not None
        assert (data.q.tolist(), data.u.tolist(), data.hold) == (expected.q.tolist(), expected.u.tolist(), "zero")
    back = np.r_[union((T, X, None)), union((T[5:6], X[5:6], U[:1]))]  # x itself is not in order
    with pytest.raises(InputError, match=r"row 42, column 't': 0\.5 does not increase on 3\.9"):
        load(written(tmp_path, back))


def test_coordinates_with_clocks_of_their_own(tmp_path, capsys):
    # fails if two sensors that never share a row are refused, or the rarer one is made up between its samples
    fine = np.arange(150) * 0.031 + 0.002
    both = union((T, X, None), (fine, None, np.cos(2 * fine)))
    data = load(written(tmp_path, both[np.argsort(both[:, 0])], "t[s],x[m],y[m]"))
    whole = data.complete
    assert (data.t[whole].tolist(), data.q[whole, 0].tolist()) == (T[1:].tolist(), X[1:].tolist())  # y begins later
    assert data.q[whole, 1].numpy() == pytest.approx(np.cos(2 * T[1:]), abs=3e-6)
    assert data.t[~whole].tolist() == [t for t in fine.tolist() if T[1] < t < T[-1] and t != T[18]]
    said = "warning: a.csv: x and y are seldom in one row, and are interpolated at the times of the rarest"
    assert said in capsys.readouterr().err


def test_blanks_by_chance_leave_the_other_cells(tmp_path, capsys):
    # fails if a blank costs the cells beside it, or counts as a reading
    y = np.cos(T)
    y[::4] = np.nan
    x = np.where(np.arange(40) % 5 == 1, np.nan, X)
    data = load(written(tmp_path, union((T, x, y)), "t[s],x[m],y[m]"))
    both = np.column_stack([x, y])
    rows = (np.arange(40) >= 2) & ~np.isnan(both).all(1)  # the first two have one each, rows 16 and 36 none
    assert data.t.tolist() == T[rows].tolist()
    assert data.observed is not None
    assert data.observed.tolist() == (~np.isnan(both)[rows]).astype(float).tolist()
    read = data.observed > 0
    assert data.q[read].tolist() == both[rows][read.numpy()].tolist()
    assert data.q[:, 1].numpy() == pytest.approx(np.cos(T[rows]), abs=2e-4)  # a cubic
    assert "missing positions, which have no weight in a fit: x in 5, y in 7 of 36 rows" in capsys.readouterr().err


def test_frames_and_the_command_line(tmp_path, capsys):
    # fails if a frame of merged tables is refused, or --hold reaches the inputs only when they have been held
    both = merged()
    frame = as_trajectories({"t": both[:, 0], "x": both[:, 1], "u": both[:, 2]})
    assert frame.u.tolist() == read_csv(written(tmp_path, both, "t,x,u")).u.tolist()  # type: ignore[union-attr]
    path = written(tmp_path, both)
    # every 99th of 38 samples is one: the command ends when the recording has been read
    assert main(["fit", str(path), "--hold", "first", "--every", "99", "--out", str(tmp_path / "run")]) == 2
    assert "straight lines go there" in capsys.readouterr().err
