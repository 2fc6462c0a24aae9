"""One bad recording among good ones is left out and said; stamps that repeat are times again, or left out."""

import numpy as np
import pytest

from herglotz.data import as_trajectories, load
from herglotz.data.clocks import numbers_of_rows
from herglotz.data.csv_format import write_csv
from herglotz.errors import InputError


def written(folder, header, rows, name="a.csv"):
    text = "\n".join(",".join("" if x != x else x if isinstance(x, str) else repr(x) for x in row) for row in rows)
    (folder / name).write_text(f"{header}\n{text}\n")
    return folder / name


def recordings(lengths, start=0):
    """Rows run, t, x of recordings of these lengths, their labels from `start`."""
    return [[b, 0.1 * k, float(np.sin(b + k))] for b, n in enumerate(lengths, start) for k in range(n)]


BAD = {
    "too few rows": ([[5, 0.0, 1.0], [5, 0.1, 2.0]], "row 14, column 'run': '5' has 2 samples, at least 3 are needed"),
    "out of order": (
        [[5, 0.0, 1.0], [5, 0.2, 2.0], [5, 0.1, 3.0]],
        "row 16, column 't': 0.1 does not increase on 0.2 in row 15",
    ),
    "too few values": (
        [[5, 0.0, 1.0], [5, 0.1, np.nan], [5, 0.2, np.nan], [5, 0.3, 1.0]],
        "row 14: of the 4 rows from here, 2 have a value in every column, at least 3 are needed",
    ),
}


@pytest.mark.parametrize("kind", BAD)
def test_one_bad_recording_is_left_out(tmp_path, capsys, kind):
    # fails if one recording refuses the file, or goes without a word of its place and its fault
    rows, why = BAD[kind]
    good = recordings([4, 4, 4])
    data = load(written(tmp_path, "run,t,x", good + rows))
    assert data.lengths == (4, 4, 4)
    assert data.q[:, 0].tolist() == [x for _, _, x in good]
    assert f"warning: a.csv: 1 of 4 recordings is left out: {why}\n" in capsys.readouterr().err
    table = dict(zip(("run", "t", "x"), np.array(good + rows).T, strict=True))
    assert as_trajectories(table).lengths == (4, 4, 4)


def test_most_recordings_have_to_be_good(tmp_path, capsys):
    # fails if a column that numbers no recordings leaves a remnant, or all that is said is of the first
    several = recordings([4, 2, 2, 4])
    data = load(written(tmp_path, "run,t,x", several))
    assert data.lengths == (4, 4)
    said = "warning: a.csv: 2 of 4 recordings are left out: the first: row 6, column 'run': '1' has 2 samples"
    assert said in capsys.readouterr().err
    with pytest.raises(InputError, match="row 6, column 'run': '1' has 2 samples, at least 3 are needed; delete it or"):
        load(written(tmp_path, "run,t,x", recordings([4, 2, 2])))
    with pytest.raises(InputError, match="the file has 2 samples"):
        load(written(tmp_path, "t,x", [[0.0, 1.0], [1.0, 2.0]]))


def test_a_file_that_is_too_short_among_others(tmp_path, capsys):
    # fails if one short file refuses its folder, or a file with a mistake goes with a warning
    for name, n in (("a.csv", 5), ("b.csv", 2), ("c.csv", 4)):
        written(tmp_path, "t,x", [[0.1 * k, float(k * k)] for k in range(n)], name)
    assert load(tmp_path).lengths == (5, 4)
    err = capsys.readouterr().err
    assert "1 of 3 recordings is left out" in err
    assert "b.csv, row 2: the file has 2 samples, at least 3 are needed" in err
    assert "2 recordings: a.csv, c.csv" in err
    (tmp_path / "b.csv").write_text("t,x\n0,1\n1,wrong\n2,3\n")
    with pytest.raises(InputError, match="'wrong' is not a number"):
        load(tmp_path)


def stamped(rate, n=300, count=1e-3, jitter=0.0, way=np.floor):
    """True times, and stamps in whole counts."""
    t = np.arange(n) / rate + jitter * np.random.default_rng(0).standard_normal(n)
    return t, way(t / count + 1e-6) * count


@pytest.mark.parametrize("way", [np.floor, np.round])
@pytest.mark.parametrize("rate", [1010, 1500, 2000, 4100])
def test_stamps_that_count_too_slowly_are_a_clock(tmp_path, capsys, rate, way):
    # fails if whole milliseconds are refused where samples come faster, or a step is a whole count or nothing
    t, stamps = stamped(rate, way=way)
    data = load(written(tmp_path, "t,x", np.column_stack([stamps, np.sin(50 * t)]).tolist()))
    assert data.samples == 300
    found = data.t.numpy()
    assert np.diff(found) == pytest.approx(np.full(299, 1 / rate), rel=2e-3)
    assert np.abs(found - t).max() < 1.1e-3
    said = (
        f"warning: a.csv: {300 - len(np.unique(stamps))} of 300 rows have the stamp of the row before: stamps count "
        f"0.001 s, and rows are taken to be {np.diff(found).mean():.4g} s apart, as their number says"
    )
    assert said in capsys.readouterr().err


def lossy(rate, n, share, start=0.3, seed=0):
    """Times and stamps in counts of 1 of samples of a clock that loses this share of them."""
    kept = np.random.default_rng(seed).random(n) >= share
    t = (np.arange(n)[kept] + start) / rate
    return t, np.floor(t)


@pytest.mark.parametrize(("rate", "share"), [(2.5, 0.1), (2.5, 0.3), (np.pi, 0.1), (1.37, 0.05)])
def test_rows_that_are_missing_leave_a_clock(tmp_path, capsys, rate, share):
    # fails if a lost row makes a stamp of all the rows that have it, a row whose tick is unknown has a position, or
    # the inputs of such a row are lost
    t, stamps = lossy(rate, 3000, share)
    path = written(tmp_path, "t[ms],x,u", np.column_stack([stamps, t * t, t]).tolist())
    data = load(path)
    found, x = 1e3 * data.t.numpy(), data.q[:, 0].numpy()
    late = found - t[np.isin(t * t, x)]
    assert np.ptp(late) < 0.01
    assert abs(late.mean()) < 1
    at, rows = np.unique(stamps, return_counts=True)
    ticks = np.array([((np.arange(3000) + 0.3) / rate // 1 == k).sum() for k in at])
    # Of the ticks at 1.37 in a count, one of 137 is at the end of a count.
    assert data.samples == pytest.approx(rows[rows == ticks].sum(), rel=1e-2)
    err = capsys.readouterr().err
    assert "rows have the stamp of the row before: stamps count 1 ms, and rows are taken to be" in err
    assert f"{len(t) - data.samples} rows, whose stamps do not tell beside which rows, have no position" in err


@pytest.mark.parametrize(
    "stamps",
    [
        np.repeat(np.arange(1000), 1 + (np.random.default_rng(0).random(1000) < 0.1)),
        np.sort(np.random.default_rng(0).integers(0, 400, 1000)),
        np.sort(np.floor(np.arange(1000) / 2.5 + 0.2 * np.random.default_rng(0).standard_normal(1000))),
        np.repeat(10 * np.arange(100), 10),
        np.floor(lossy(1.37, 3000, 0.05)[0] + 0.02 * np.sin(np.arange(2840))),
    ],
    ids=[
        "rows at random",
        "times at random",
        "stamps that jitter",
        "batches",
        "the reflection of a clock that jitters",
    ],
)
def test_stamps_that_show_no_clock(stamps):
    # fails if a clock is read into stamps that none made
    assert numbers_of_rows(stamps.astype(float), 1e-3) is None


def test_stamps_in_milliseconds(tmp_path):  # fails if counts are looked for in seconds alone
    t, stamps = stamped(1500, jitter=2e-5)
    data = load(written(tmp_path, "t[ms],x", np.column_stack([1e3 * stamps, np.sin(50 * t)]).tolist()))
    assert data.typical_step == pytest.approx(1 / 1500, rel=2e-3)


UNEVEN = np.arange(60) + 0.15 * np.sin(np.arange(60))
REPEATS = {
    "a row twice": (np.r_[0:50, 49:100], np.r_[0:50, 49:100], 1),
    "another row with its stamp": (np.r_[0:50, 49:100], np.arange(101), 1),
    "three rows twice": (np.repeat(np.arange(100), 1 + (np.arange(100) % 33 == 20)), None, 3),
    "a clock that stood": (np.r_[0:50, [49] * 9, 50:100], np.arange(109), 9),
    "no counts, in equal parts": (np.repeat(UNEVEN, 1 + (np.arange(60) % 20 == 10)), np.arange(63), 3),
    "no counts": (np.r_[0:50, 49:100] + 0.3 * np.sin(np.r_[0:50, 49:100]), np.arange(101), 1),
}


@pytest.mark.parametrize("kind", REPEATS)
def test_other_rows_with_the_stamp_before_are_left_out(tmp_path, capsys, kind):
    # fails if rows that were written twice, or a clock that stood, change all times; or the file is refused
    stamps, x, count = REPEATS[kind]
    x = stamps if x is None else x
    rows = np.column_stack([0.01 * stamps, np.sin(0.1 * x)]).tolist()
    data = load(written(tmp_path, "t,x", rows))
    assert data.t.tolist() == (0.01 * np.unique(stamps)).tolist()
    some = "a row is" if count == 1 else f"{count} rows are"
    at = int(np.flatnonzero(np.diff(stamps) == 0)[0]) + 3
    said = f"warning: a.csv: {some} left out, with the stamp of the row before: the first is row {at}\n"
    assert said in capsys.readouterr().err


def test_several_recordings_are_said_once(tmp_path, capsys):  # fails if every recording has a line of its own
    clocks = [np.column_stack(stamped(1500 + 100 * b)).tolist() for b in range(4)]
    rows = [[b, stamp, float(np.sin(50 * t))] for b, clock in enumerate(clocks) for t, stamp in clock]
    data = load(written(tmp_path, "run,t,x", rows))
    assert data.lengths == (300,) * 4
    err = capsys.readouterr().err
    assert err.count("warning") == 1
    assert "as their number says, and so of 3 more recordings" in err


GUESSED = "warning: a.csv: {} is taken for the number of the recording, but by its values alone"


@pytest.mark.parametrize("name", ["swing", "test", "Messung", "load[kg]"])
@pytest.mark.parametrize("lengths", [(4, 5), (4, 5, 4)])
def test_a_column_that_changes_where_time_starts_anew_numbers_the_recordings(tmp_path, capsys, name, lengths):
    # fails if the rule needs a word of a list, or three recordings; or if the guess is not said
    path = written(tmp_path, f"{name},t,x,y", [[*row, row[2] ** 2] for row in recordings(lengths, 1)])
    data = load(path)
    own = name.split("[")[0]
    assert (data.lengths, data.names) == (lengths, ("x", "y"))
    assert GUESSED.format(own) in (err := capsys.readouterr().err)
    assert f"{own} is taken for a coordinate" not in err
    frame = {name: [row[0] for row in recordings(lengths, 1)], "t": data.t.numpy(), "x": data.q[:, 0].numpy()}
    assert as_trajectories(frame).lengths == lengths
    # Another table has the same columns, also with a single recording.
    capsys.readouterr()
    one = written(tmp_path, f"{name},t,x,y", [[*row, row[2] ** 2] for row in recordings([5], 7)])
    assert load(one, like=data).names == ("x", "y")
    assert "warning" not in capsys.readouterr().err


def test_a_column_left_aside_may_number_the_recordings(tmp_path, capsys):
    # fails if only coordinates are looked at, or a column that the user drops has a role
    path = written(tmp_path, "index,t,x", recordings([4, 5], 1))
    assert load(path).lengths == (4, 5)
    assert load(path, coordinates="x").lengths == (4, 5)
    capsys.readouterr()
    assert load(path, drop="index").recordings == ("rows 2 to 5", "rows 6 to 10")
    assert "index is taken for" not in capsys.readouterr().err
    # A temperature of each recording stays aside; the coordinate that cannot be one leaves.
    rows = [[20 + b, b, t, x] for b, t, x in recordings([4, 5], 1)]
    assert load(written(tmp_path, "temp,load,t,x", rows)).names == ("x",)
    known = load(written(tmp_path, "temp,load,t,x", [[20, k % 3, t, x] for k, (_, t, x) in enumerate(recordings([9]))]))
    again = load(written(tmp_path, "load,t,x", recordings([4, 5], 1)), like=known)
    assert (again.names, again.lengths) == (("load", "x"), (4, 5))


def test_stacked_tables_are_one_recording(tmp_path):
    # fails if the rows of a second sensor, behind those of the first, are a second recording without the first's values
    nan = float("nan")
    rows = [[0, 0.1 * k, k**2, nan] for k in range(6)] + [[1, 0.1 * k, nan, k**3] for k in range(6)]
    assert load(written(tmp_path, "index,t,x,y", rows)).lengths == (6,)


@pytest.mark.parametrize(
    ("rows", "lengths"),
    [
        ([[k // 3, 0.1 * (k % 6), k**2] for k in range(12)], (6, 6)),
        ([[k // 6 % 2, 0.1 * (k % 6), k**2] for k in range(18)], (6, 6, 6)),
    ],
    ids=["changes elsewhere too", "values come again"],
)
def test_other_columns_do_not_number_recordings(tmp_path, capsys, rows, lengths):
    # fails if a coordinate is taken for a number of recordings where only some of its values fit
    data = load(written(tmp_path, "load,t,x", rows))
    assert (data.names, data.lengths) == (("load", "x"), lengths)
    assert "t falls back at row" in (err := capsys.readouterr().err)
    assert "wherever time starts anew" not in err
    with pytest.raises(InputError, match=r"load moves in jumps alone \(0, 1\); an input\? --inputs load"):
        load(written(tmp_path, "load,t,x", [[int(6 <= k < 9), 0.1 * (k % 6), k**2] for k in range(12)]))


def test_rows_in_no_order_are_refused(tmp_path):
    # fails if rows that are out of order are recordings
    rows = [[0, 0.0, 0], [0, 0.1, 1], [0, 0.3, 9], [1, 0.2, 4], [2, 0.15, 3], [3, 0.12, 3]]
    with pytest.raises(InputError, match=r"row 5, column 't': .* sort the rows"):
        load(written(tmp_path, "load,t,x", rows))


@pytest.mark.parametrize(
    "name", ["Versuch", "Essai", "experiment", "recording", "trial_id", "run_nr", "Lauf", "prueba", "Run #", "run no."]
)
def test_names_of_recordings_group_rows(tmp_path, capsys, name):
    # fails if a usual name numbers recordings in other languages as a coordinate, or with a warning
    data = load(written(tmp_path, f"{name},t,x", [[b, k, x] for k, (b, _, x) in enumerate(recordings([4, 5]))]))
    assert (data.lengths, data.names) == ((4, 5), ("x",))
    assert "warning" not in capsys.readouterr().err


def test_a_unit_makes_a_quantity_of_a_recordings_name(tmp_path):
    # fails if the position of a test run, in mm, groups its rows
    assert load(written(tmp_path, "run[mm],t", [[x, t] for _, t, x in recordings([9])])).names == ("run",)


def test_a_column_that_numbers_the_recordings_is_named(tmp_path, capsys):
    # fails if a constant torque of each of two recordings is no input, or that it may number them is not said
    path = written(tmp_path, "torque,t,x", recordings([4, 5], 1))
    data = load(path)
    assert (data.lengths, data.input_labels) == ((4, 5), (("torque", ""),))
    said = "column 'torque' changes wherever time starts anew: --group torque (group= in Python)"
    assert said in capsys.readouterr().err
    assert load(path, group="torque", show=False).lengths == (4, 5)
    # One row out of order is no second recording.
    with pytest.raises(InputError, match="sort the rows, delete one, or number the trajectories"):
        load(written(tmp_path, "t,x,y", [[0.0, 1.0, 1.0], [0.2, 1.0, 2.0], [0.1, 2.0, 3.0], [0.3, 2.0, 4.0]]))


SET_BACK = [[0.1 * k - 0.75 * (k >= 20), float(np.sin(k))] for k in range(40)]


def test_a_clock_that_was_set_back(tmp_path, capsys):
    # fails if rows of two motions are refused, or sorted into one another, or the rows are not named
    repeated = [*SET_BACK[:5], SET_BACK[4], *SET_BACK[5:]]
    table = {"t[s]": np.array(SET_BACK)[:, 0], "x[m]": np.array(SET_BACK)[:, 1]}
    path, other = (
        written(tmp_path, "t[s],x[m]", rows, name) for rows, name in ((SET_BACK, "a.csv"), (repeated, "b.csv"))
    )
    for row, read in ((22, lambda: load(path)), (23, lambda: load(other)), (20, lambda: as_trajectories(table))):
        data = read()
        assert (data.lengths, data.t.tolist(), data.q[:, 0].tolist()) == (
            (20, 20), [t for t, _ in SET_BACK], [x for _, x in SET_BACK]
        )  # fmt: skip
        assert data.recordings[1].startswith(f"rows {row} to ")
        said = f"t falls back at row {row}, and a new recording begins; if it is one recording, sort the rows; a column"
        assert said in capsys.readouterr().err
    data = load(written(tmp_path, "run,t[s],x[m]", [["b", *row] for row in SET_BACK]))
    assert (data.lengths, data.recordings) == ((20, 20), ("run b", "run b (2)"))
    two = load(written(tmp_path, "run,t[s],x[m]", [["ab"[k >= 20], *row] for k, row in enumerate(SET_BACK)]))
    assert two.recordings == ("run a", "run b")


def test_a_clock_that_begins_again(tmp_path, capsys):
    # fails if several logs below one another are refused, or more than four rows are named
    logs = [[3.2 + 0.04 * k, float(np.sin(b + k))] for b in range(7) for k in range(5 + b)]
    data = load(written(tmp_path, "zeit,x", logs))
    assert data.lengths == tuple(range(5, 12))
    said = "zeit falls back at rows 7, 13, 20, 28, 2 more, and a new recording begins at each"
    assert said in capsys.readouterr().err
    # A logger that was started long after its clock, and once more with its clock.
    late = load(written(tmp_path, "t,x", [[t, float(t**2)] for t in (*range(500, 509), *range(7))]))
    assert late.lengths == (9, 7)


@pytest.mark.parametrize(
    ("t", "row"),
    [
        ([0.0, 0.1, 0.2, 0.3, 0.05, 0.5, 0.6, 0.7, 0.8], 6),
        ([0.0, 0.1, 0.2, 0.9, 0.4, 0.5, 0.6, 0.7, 0.8], 6),
        ([0.0, 0.1, 0.2, 0.6, 0.7, 0.8, 0.3, 0.4, 0.5], 8),
        ([0.0, 0.1, 0.1, 0.3, 0.2, 0.4, 0.5, 0.6, 0.7], 6),
    ],
    ids=["a stamp that is too small", "one that is too large", "a block in another place", "a repeat before two rows"],
)
def test_rows_out_of_order_are_sorted(tmp_path, t, row):
    # fails if a wrong stamp or rows in another place are taken for a clock that was set back
    with pytest.raises(
        InputError, match=rf"row {row}, column 't': .* does not increase on .*; sort the rows, delete one"
    ):
        load(written(tmp_path, "t,x", [[x, float(k)] for k, x in enumerate(t)]))


def cells(*columns):
    """The rows of these columns."""
    return [list(row) for row in zip(*columns, strict=True)]


CLOCK = [0.1 * (k % 4) for k in range(12)]
MOTION = [(k + 1) ** 1.5 for k in range(12)]


@pytest.mark.parametrize(
    ("labels", "names"),
    [
        (["a"] * 4 + ["b"] * 4 + ["c"] * 4, ["a", "b", "c"]),
        (["up"] * 4 + ["down"] * 4 + ["up"] * 4, ["up", "down", "up (2)"]),
        (["one.csv"] * 4 + ["two.csv"] * 4 + ["3"] * 4, ["one.csv", "two.csv", "3"]),
    ],
    ids=["letters", "phases come again", "names of files"],
)
@pytest.mark.parametrize("name", ["swing", "file", "action"])
def test_a_column_of_text_that_changes_where_time_starts_anew_groups_the_rows(tmp_path, capsys, labels, names, name):
    # fails if text is refused as no number, two recordings of one phase become one, or a frame is read otherwise
    rows = cells(labels, CLOCK, MOTION)
    path = written(tmp_path, f"{name},t,x", rows)
    frame = dict(zip((name, "t", "x"), map(np.array, zip(*rows, strict=True)), strict=True))
    for data in (load(path), as_trajectories(frame), load(path, group=name)):
        assert (data.lengths, data.names, data.u) == ((4, 4, 4), ("x",), None)
        assert data.recordings == tuple(f"{name} {one}" for one in names)
    said = f"{name} is taken for the name of the recording, but by its values alone"
    assert capsys.readouterr().err.count(said) == 2


@pytest.mark.parametrize(
    ("header", "labels", "cell"),
    [("swing,t,x", ["a"] * 5 + ["b"] * 7, "a"), ("y[m],t,x", ["lost"] * 4 + ["none"] * 4 + ["found"] * 4, "lost")],
    ids=["changes elsewhere", "a position"],
)
def test_other_text_is_refused_with_both_remedies(tmp_path, header, labels, cell):
    # fails if text that groups no rows is left aside unsaid, or a remedy is missing
    name = header.split(",")[0].split("[")[0]
    with pytest.raises(InputError, match=f"row 2, column '{name}': '{cell}' is not a number; .*--drop {name} .*--group "
                       f"{name} "):  # fmt: skip
        load(written(tmp_path, header, cells(labels, CLOCK, MOTION)))
    path = written(
        tmp_path, "trial,swing,t,x", cells([k // 4 for k in range(12)], ["a"] * 5 + ["b"] * 7, CLOCK, MOTION)
    )
    with pytest.raises(InputError, match=r"column 'swing': 'a' is not a number; .*--drop swing .*--group swing "):
        load(path)


@pytest.mark.parametrize("cell", [0, 2, "shoulder"])
def test_a_column_that_is_the_same_in_every_row_is_left_aside(tmp_path, capsys, cell):
    # fails if a status that never changes is a coordinate (0 was, and a fit with inputs ended with an internal error),
    # if text refuses the table, or if the only coordinate, or one that a unit or the user names, is left aside
    t = [0.1 * k for k in range(12)]
    x = [0.1, 0.3, 0.4, 0.2, 0.0, 0.1, 0.3, 0.5, 0.4, 0.2, 0.1, 0.0]
    data = load(written(tmp_path, "mode,t,x,u", cells([cell] * 12, t, x, x[::-1])))
    assert data.names == ("x",)
    assert "mode is the same in every row, and is left aside" in capsys.readouterr().err
    if cell != "shoulder":
        named = load(written(tmp_path, "mode,t,x", cells([cell] * 12, t, x)), coordinates=("x", "mode"))
        assert named.names == ("x", "mode")
        assert load(written(tmp_path, "mode[m],t,x", cells([cell] * 12, t, x))).names == ("mode", "x")
        # What is written is read again, and a joint that one file of a folder holds still is a joint.
        (folder := tmp_path / "joints").mkdir()
        write_csv(tmp_path / "again.csv", named)
        assert load(tmp_path / "again.csv").names == ("x", "mode")
        written(folder, "mode,t,x", cells([cell] * 12, t, x), "held.csv")
        written(folder, "mode,t,x", cells(x[::-1], t, x), "moved.csv")
        assert set(load(folder).names) == {"mode", "x"}
        assert load(written(tmp_path, "t,mode", cells(t, [cell] * 12))).names == ("mode",)


@pytest.mark.parametrize("constant", ["experiment", "trial id", "session", "place"])
@pytest.mark.parametrize("cell", [3, "lab"])
def test_a_column_that_is_the_same_in_every_row_is_left_aside_beside_the_groups(tmp_path, capsys, constant, cell):
    # fails if it is refused, is a coordinate, or leaves without a word; if a group that varies does
    run = [k // 4 for k in range(12)]
    data = load(written(tmp_path, f"{constant},run,t,x", cells([cell] * 12, run, CLOCK, MOTION)))
    assert (data.lengths, data.names) == ((4, 4, 4), ("x",))
    assert dict((name, role) for name, role, _ in data.columns)[constant] == "left aside"
    assert f"{constant} is the same in every row, and is left aside" in capsys.readouterr().err
    with pytest.raises(InputError, match="both a column experiment and a column run; keep one"):
        load(written(tmp_path, "experiment,run,t,x", cells(run[::-1], run, CLOCK, MOTION)))
    # A coordinate that says what it is stays, and the fit says that it never moves.
    assert load(written(tmp_path, "y[m],run,t,x", cells([3] * 12, run, CLOCK, MOTION))).names == ("y", "x")


def test_a_position_numbers_no_recordings(tmp_path, capsys):
    # fails if a height that is another in each recording leaves the coordinates
    path = written(tmp_path, "y[m],t,x[m]", cells([k // 4 for k in range(12)], CLOCK, MOTION))
    assert load(path).names == ("y", "x")
    assert "changes wherever time starts anew: --group y (group= in Python)" in capsys.readouterr().err
    assert load(path, group="y").lengths == (4, 4, 4)
    index = written(tmp_path, "y[m],index,t,x", cells([3] * 12, [k // 4 for k in range(12)], CLOCK, MOTION))
    assert (load(index).lengths, load(index).names) == ((4, 4, 4), ("y", "x"))
