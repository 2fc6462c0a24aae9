"""Tables of measuring programs, spreadsheets, pandas and MATLAB: read right, or refused with what to do."""

import importlib.util
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from herglotz.data import as_trajectories, load
from herglotz.errors import InputError

T = np.arange(6) * 0.5
X = np.array([1.25, -0.5, 3e-3, 4.0, -5.125, 6.0])


def written(tmp_path, text, encoding="utf-8"):
    (tmp_path / "a.csv").write_bytes(text.encode(encoding))
    return tmp_path / "a.csv"


def rows(separator=",", *more):
    return "".join(separator.join(map(str, (t, x, *more))) + "\n" for t, x in zip(T, X, strict=True))


@pytest.mark.parametrize(
    ("header", "units", "rate"),
    [
        ("t,theta,omega", "s,rad,rad/s", "rad/s"),
        ("t,theta,omega", "[s],[rad],[rad/s]", "rad/s"),
        ("t,theta,load", "(s),(rad),-", ""),
        ("t,theta[rad],load", "s,rad,1", "1"),
    ],
)
def test_units_in_a_row_of_their_own(tmp_path, header, units, rate):
    # fails if units below the header are refused, lost, or a column does not get the role of its unit
    text = "".join(f"{t},{x},{7 + x}\n" for t, x in zip(T, X, strict=True))
    data = load(written(tmp_path, f"{header}\n{units}\n{text}"), unwrap=False)
    assert data.names[0] == "theta"
    assert (data.units[0], data.angles[0], data.time_unit) == ("rad", True, "s")
    assert (data.t.tolist(), data.q[:, 0].tolist()) == (T.tolist(), X.tolist())
    role = "left aside" if rate == "rad/s" else "coordinate"
    assert data.columns[2] == (header.split(",")[2], role, rate)
    assert "  units stand in row 2" in data.table().splitlines()


LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nTime\t10:22:31.22\n***End_of_Header***\t\n\t\n"
    "Samples\t6\t6\nX_Dimension\tTime\tTime\n***End_of_Header***\t\t\nX_Value\tPath (mm)\tForce (N)\n"
)


def test_a_preamble_of_labview(tmp_path):
    # fails if a measurement file of LabVIEW is refused for its preamble, or its X_Value is no time
    path = tmp_path / "a.lvm"
    path.write_text(LABVIEW + rows("\t", 2.5))
    data = load(path)
    assert [role for _, role, _ in data.columns] == ["time", "coordinate", "input"]
    assert (data.time_unit, data.t.tolist(), data.q[:, 0].tolist()) == ("s", T.tolist(), X.tolist())
    assert any(note == "8 lines above the header, which is row 10, left out" for note in data.notes)
    # Where nothing follows the preamble, the message is of the file.
    path.write_text(LABVIEW.partition("X_Value")[0])
    with pytest.raises(InputError, match=r"a\.lvm, row 1"):
        load(path)


def test_times_of_several_channels_of_labview(tmp_path, capsys):
    # fails if the time of the second channel is a coordinate, a comment is warned of, or other times are overlooked
    path, preamble = tmp_path / "a.lvm", LABVIEW.partition("X_Value")[0]
    heads = "X_Value\tPath (mm)\tX_Value\tForce (N)\tComment\n"
    body = [f"{t}\t{x}\t{t}\t2\t\n" for t, x in zip(T, X, strict=True)]
    path.write_text(preamble + heads + "".join(body))
    data = load(path)
    assert data.columns == (("X_Value", "time", "s"), ("Path", "coordinate", "mm"), ("Force", "input", "N"))
    assert (data.t.tolist(), data.q[:, 0].tolist()) == (T.tolist(), X.tolist())
    assert "warning" not in capsys.readouterr().err
    path.write_text(preamble + heads + body[0] + body[1].replace(f"\t{T[1]}\t", "\t7.5\t"))
    with pytest.raises(InputError, match=rf"row 12: channels have different times, '{T[1]}' and '7.5'; save them with"):
        load(path)
    path.write_text(preamble + heads.replace("X_Value\tForce", "Force") + "\t1\t2\t\n\t3\t2\t\n")
    with pytest.raises(InputError, match="row 11: X_Value is blank; save them with one column of times"):
        load(path)


def test_columns_without_a_value_are_left_aside(tmp_path, capsys):
    # fails if an empty column of remarks refuses the table, as of all rows none is complete, or is left out in silence
    data = load(written(tmp_path, f"t[s];x[cm];remarks;by\n{rows(';', '', '')}"))
    assert (data.names, data.u) == (("x",), None)
    assert [role for _, role, _ in data.columns] == ["time", "coordinate", "left aside", "left aside"]
    assert "warning: a.csv: remarks, by have no value in any row, and are left aside" in capsys.readouterr().err
    with pytest.raises(InputError, match="of the 6 rows from here, 0 have a value in every column"):
        load(written(tmp_path, f"t[s];x[cm]\n{''.join(f'{t};' + chr(10) for t in T)}"))


def test_units_below_are_converted(tmp_path):  # fails if ms and degrees of such a row stay, or of another separator
    data = load(written(tmp_path, f"t;phi;F\n[ms];[°];[N]\n{rows(';', 2)}"), unwrap=False)
    assert data.t.tolist() == (T / 1000).tolist()
    assert data.q[:, 0].tolist() == pytest.approx(np.radians(X), rel=1e-15)
    assert data.input_labels == (("F", "N"),)
    assert data.columns[0] == ("t", "time", "ms")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t[s],x[m]\ns,mm\n", r"row 1: two units of one column, 'x\[m\]' and below it 'mm'"),
        ("t,x\ns,5\n", "row 2, column 't': 's' is not a number"),
        ("t,x\nfoo,bar\n", "row 2, column 't': 'foo' is not a number"),
        ("t,x\nm,s\n", "row 1: no coordinate column, only t, x; x looks like no position"),
        ("t,x\n,m\n", "row 2, column 't': a blank cell is not a number"),
    ],
)
def test_a_row_that_is_no_row_of_units(tmp_path, text, message):
    # fails if a damaged row is swallowed as units, or two units of one column are one by chance
    with pytest.raises(InputError, match=message):
        load(written(tmp_path, text + rows()))


@pytest.mark.parametrize(
    "text",
    [
        "t,x,,\n" + rows(",", "", ""),
        "t,x\n" + rows(",", "", ""),
        "t,x,,\n" + rows(),
        "t;x;;\n" + rows(";", "", ""),
        't;x\n"0";"1,25"\n' + rows(";")[len("0.0;1.25\n") :].replace(".", ","),
        't,x\n"0","1,25"\n' + "".join(f'"{t}","{x}"\n'.replace(".", ",") for t, x in zip(T[1:], X[1:], strict=True)),
        "sep=;\nt;x\n" + rows(";").replace(".", ","),
    ],
)
def test_what_spreadsheets_write(tmp_path, text):
    # fails if empty columns at the end, quoted decimal commas, or Excel's own first line are refused or misread
    data = load(written(tmp_path, text.replace("\n", "\r\n")))
    assert (data.names, data.t.tolist(), data.q[:, 0].tolist()) == (("x",), T.tolist(), X.tolist())


def test_a_last_column_without_a_name_is_not_lost(tmp_path):  # fails if numbers without a header are left out unsaid
    with pytest.raises(InputError, match="column 3: '' is not a header cell"):
        load(written(tmp_path, "t,x,\n" + rows(",", 5)))
    with pytest.raises(InputError, match="row 2: 3 cells where the header has 2"):
        load(written(tmp_path, "t,x\n" + rows(",", 5)))
    with pytest.raises(InputError, match="row 3: 3 cells where the header has 2"):
        load(written(tmp_path, "t,x\n0,1,\n1,2,9\n2,3,\n"))
    gap = load(written(tmp_path, "t,x\n" + rows() + "3.5,\n4,1\n"))  # the last cell is empty, and its column is not
    assert gap.samples == 7


def test_unicode_text(tmp_path):  # fails if what spreadsheets call so, UTF-16 with tabs, is refused
    data = load(written(tmp_path, "t\tx\n" + rows("\t"), "utf-16"))
    assert data.q[:, 0].tolist() == X.tolist()
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(InputError, match="not UTF-8 text"):
        load(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            't,x\n0,"900"\n1,"950"\n2,"1,000"\n3,"1,050"\n',
            r"row 4: '1,000' may be 1000 or 1\.000; write numbers without",
        ),
        ('t,x\n0,"5,000.5"\n1,"6,000.5"\n2,"7,0.5"\n', r"row 2: '5,000.5' has a separator of thousands"),
        ("t;x\n0;1.250,5\n1;2,5\n2;3\n", r"row 2: '1.250,5' has a separator of thousands; write numbers without it"),
        ("t;x\n0;1,234,567\n1;2,5\n2;3\n", "row 2: '1,234,567' has a separator of thousands"),
        ("Device 7\n2026\nclock,x\n0,1\n1,2\n2,3\n", "'Device 7' is no header; delete the lines above the table"),
        ("timestamp,x\n86000000000000,1\n86000000000050,2\n86000000000100,3\n", r"write its unit, timestamp\[ms\]"),
        ("date,time,x\n2026-03-01,12:00:00,1\n2026-03-01,12:00:01,2\n", "two time columns, date and time; choose one"),
    ],
)
def test_mistakes_say_what_to_do(tmp_path, text, message):
    # fails if thousands become decimals, a title is taken for the header, or another clock's large counts for seconds
    with pytest.raises(InputError, match=message):
        load(written(tmp_path, text))


def test_decimal_commas_of_three_digits(tmp_path):  # fails if commas that cannot be of thousands are refused
    for one, value in (("0,250", 0.25), ("-1,25", -1.25), ("1234,500", 1234.5)):
        data = load(written(tmp_path, f't,x\n0,"{one}"\n1,"1,250"\n2,"2,500"\n'))
        assert data.q[:, 0].tolist() == [value, 1.25, 2.5]


@pytest.mark.parametrize(("header", "scale"), [("timestamp", 1), ("timestamp[us]", 10**6), ("timestamp[ms]", 10**3)])
def test_times_since_1970(tmp_path, header, scale):  # fails if seconds since 1970, or others with a unit, are refused
    start = 1_700_000_000
    data = load(written(tmp_path, f"{header},x\n" + "".join(f"{(start + k) * scale},{k}\n" for k in range(4))))
    assert data.t.tolist() == [start + k for k in range(4)]


def test_rows_below_a_row_of_units_keep_their_numbers():  # fails if rows of a frame count from its first number
    def table(value):
        x = np.array(["m", *X], dtype=object)
        x[3] = value
        return {"t": np.array(["s", *T], dtype=object), "x": x}

    for wrong, message in (("broken", "'broken' is not a number"), (np.inf, "inf is not finite")):
        with pytest.raises(InputError, match=f"row 3, column 'x': {message}"):
            as_trajectories(table(wrong))
    assert "the first is row 3, column 'x'" in as_trajectories(table(None)).notes[0]


def test_a_comma_in_a_quoted_name(tmp_path):  # fails if one name becomes two columns, fast or row by row
    for first in ("0,1", '"0",1'):
        data = load(written(tmp_path, f't,"x, left [m]"\n{first}\n1,2\n2,3\n'))
        assert (data.names, data.units) == (("x left",), ("m",))


@pytest.mark.parametrize("unit", ["sec", "seconds"])
def test_other_words_for_seconds(tmp_path, unit):  # fails if a second is another unit than s, and no run fits it
    data = load(written(tmp_path, f"t[{unit}],x\n{rows()}"))
    assert (data.time_unit, data.t.tolist()) == ("s", T.tolist())
    assert load(written(tmp_path, f"t[msec],x\n{rows()}")).t.tolist() == (T / 1000).tolist()
    assert load(written(tmp_path, f"t[h],x\n{rows()}")).t.tolist() == pytest.approx((T * 3600).tolist(), rel=1e-15)


START = datetime(2026, 3, 1, 12, tzinfo=UTC)
CLOCKS = {
    "dates": np.array([START + timedelta(seconds=t) for t in T]),
    "naive dates": np.datetime64("2026-03-01T12:00") + (T * 1000).astype("timedelta64[ms]"),
    "durations": (T * 1000).astype("timedelta64[ms]"),
    "texts": np.array([f"2026-03-01 12:00:0{t}" for t in T], dtype=object),
    "time of day": np.array([f"12:00:0{t}00" for t in T]),
}


@pytest.mark.parametrize("kind", CLOCKS)
def test_clocks(kind, tmp_path, capsys):  # fails if nanoseconds are taken for seconds, or dates with a zone refused
    clock = CLOCKS[kind]
    assert as_trajectories({"t": clock, "x": X}).t.tolist() == T.tolist()
    unit = "- (taken for s)" if kind == "durations" else "date, converted to s"
    assert f"t       time          {unit}" in capsys.readouterr().err
    assert as_trajectories(X, time=clock).t.tolist() == T.tolist()
    if kind != "durations":
        text = "".join(f"{t},{x}\n" for t, x in zip(map(str, clock), X, strict=True))
        assert load(written(tmp_path, "time,x\n" + text)).t.tolist() == T.tolist()


def test_a_column_called_date(tmp_path):  # fails if a column `Date` is no time
    rows = "".join(f"2026-03-0{1 + t},{x}\n" for t, x in enumerate(X))
    data = load(written(tmp_path, "Date,x\n" + rows))
    assert (data.t.tolist(), data.names) == ([86400.0 * k for k in range(len(X))], ("x",))


@pytest.mark.parametrize("kind", CLOCKS)
def test_clocks_with_a_unit(kind, tmp_path):  # fails if dates below t[ms] are divided by 1000, or the delay is not
    clock = CLOCKS[kind]
    data = as_trajectories({"t[ms]": clock, "x": X})
    assert (data.t.tolist(), data.time_unit) == (T.tolist(), "s")
    if kind == "durations":
        return
    text = "".join(f"{t},{x},1\n" for t, x in zip(map(str, clock), X, strict=True))
    for header in ("t[ms],x,u\n", "t,x,u\nms,rad,N\n"):
        data = load(written(tmp_path, "# delay: 4\n" + header + text))
        assert (data.t.tolist(), data.time_unit, data.delay) == (T.tolist(), "s", 0.004)


def test_dates_of_which_some_have_a_zone():  # fails if their difference, which is not known, is a traceback
    clock = [START + timedelta(seconds=1), *(START.replace(tzinfo=None) + timedelta(seconds=t) for t in (2, 3, 4))]
    with pytest.raises(InputError, match="not all with a time zone"):
        as_trajectories({"t": np.array(clock), "x": X[:4]})


def test_a_missing_date_has_its_row():  # fails if NaT reads as a time that does not increase
    clock = CLOCKS["naive dates"].copy()
    clock[2] = np.datetime64("NaT")
    with pytest.raises(InputError, match="row 2, column 't': nan is not finite"):
        as_trajectories({"t": clock, "x": X})


class NAType:
    """As pandas.NA: a comparison with it is neither true nor false."""

    def __ne__(self, other):
        return self

    def __bool__(self):
        raise TypeError("boolean value of NA is ambiguous")


@pytest.mark.parametrize("at", [0, 2])
def test_a_gap_of_pandas(at):  # fails if NA is a traceback, or is written over in the user's own array
    x = np.array(X, dtype=object)
    x[at] = NAType()
    rest = np.delete(X, at).tolist()
    for data in (as_trajectories({"t": T, "x": x}), as_trajectories(x, h=0.5)):
        assert data.q[:, 0].tolist() == rest
    assert isinstance(x[at], NAType)


def test_masked_and_complex_numbers():  # fails if what numpy hides or drops becomes data
    mask = np.ma.masked_array(X, X > 5)
    for data in (as_trajectories(mask, h=0.5), as_trajectories({"t": T, "x": mask})):
        assert data.q[:, 0].tolist() == X[:5].tolist()
    for wrong, h in (({"t": T, "x": X + 1j}, None), (X + 1j, 0.5)):
        with pytest.raises(InputError, match="numbers are complex"):
            as_trajectories(wrong, h=h)


def test_arrays_that_are_tables_or_transposed():  # fails if fields are refused, or N and n are taken for each other
    table = np.zeros(6, dtype=[("t", float), ("x", float)])
    table["t"], table["x"] = T, X
    assert as_trajectories(table).q[:, 0].tolist() == X.tolist()
    with pytest.raises(InputError, match=r"shape \(1, 6\): few samples of many coordinates; transpose them"):
        as_trajectories(X[None], h=0.5)


def test_many_coordinates_that_are_named():  # fails if a chain of 100 masses, recorded shortly, cannot be given at all
    chain, names = np.random.default_rng(0).normal(size=(20, 100)), [f"x{k}[m]" for k in range(100)]
    data = as_trajectories(chain, h=0.1, coordinates=names)
    assert (data.q.tolist(), data.units) == (chain.tolist(), ("m",) * 100)
    for some in (None, names[:20]):
        with pytest.raises(InputError, match="or name every coordinate with coordinates="):
            as_trajectories(chain, h=0.1, coordinates=some)


@pytest.mark.parametrize("wrong", ["broken", [1, 2], {"x": 1}, datetime(2026, 3, 1)])
def test_what_is_no_number_has_its_row(wrong):  # fails if a column of a table is refused without the place
    x = np.array([None, *X[1:]], dtype=object)
    x[3] = wrong
    with pytest.raises(InputError) as error:
        as_trajectories({"t": T, "x": x})
    assert f"row 3, column 'x': {str(wrong)!r} is not a number; convert it" in str(error.value)


def test_frames():  # fails if pandas' headers of two rows, unit rows, zones or series without times are misread
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"t": T, "x": X})
    two = frame.set_axis(pandas.MultiIndex.from_tuples([("t", "ms"), ("x", "Unnamed: 1_level_1")]), axis=1)
    assert as_trajectories(two).t.tolist() == (T / 1000).tolist()
    text = pandas.concat([pandas.DataFrame({"t": ["ms"], "x": ["m"]}), frame.astype(str)])
    data = as_trajectories(text)
    assert (data.t.tolist(), data.units) == ((T / 1000).tolist(), ("m",))
    zone = pandas.date_range("2026-03-01", periods=6, freq="500ms", tz="Europe/Berlin")
    for index in (zone, pandas.to_timedelta(T, unit="s")):
        assert as_trajectories(pandas.DataFrame({"x": X}, index=index)).t.tolist() == T.tolist()
        assert as_trajectories(pandas.Series(X, index=index)).t.tolist() == T.tolist()
    with pytest.raises(InputError, match="positions without times"):
        as_trajectories(pandas.Series(X))
    assert as_trajectories(pandas.Series(X, name="x[m]"), h=0.5).units == ("m",)
    gap = pandas.DataFrame({"t": T, "x": pandas.array(X, dtype="Float64")})
    gap.loc[0, "x"] = pandas.NA
    assert as_trajectories(gap).q[:, 0].tolist() == X[1:].tolist()
    with pytest.raises(InputError, match="'x' comes twice"):
        as_trajectories(pandas.concat([frame, frame[["x"]]], axis=1))


@pytest.mark.skipif(importlib.util.find_spec("scipy") is None, reason="scipy is an extra")
def test_structs_of_matlab(tmp_path):  # fails if a struct is "no header", or several recordings become one
    from scipy.io import savemat  # pyright: ignore[reportMissingImports]

    path, one = tmp_path / "a.mat", {"t": T, "x": X, "fs": 2.0, "name": "first"}
    several = np.zeros(2, dtype=[("t", object), ("x", object)])
    for k in range(2):
        several[k] = T, X
    for stored, lengths in (
        ({"log": {"t": T, "signals": {"values": X, "label": "x"}}}, (6,)),
        ({"runs": several, "fs": 100.0, "name": "two"}, (6, 6)),
        ({"exp": {"runs": several}}, (6, 6)),
        (one, (6,)),
    ):
        savemat(path, stored)
        data = load(path)
        assert (data.lengths, data.q[:6, 0].tolist()) == (lengths, X.tolist())


@pytest.mark.parametrize("name", ["a.xlsx", "a.XLS", "a.ods"])
def test_a_spreadsheet_is_told_to_become_a_csv(tmp_path, name):
    # fails if a user with an Excel file is told ten formats in the place of what to do
    (tmp_path / name).write_bytes(b"PK\x03\x04 and more")
    with pytest.raises(InputError, match=r"is a spreadsheet; save the sheet as \.csv .*read_excel"):
        load(tmp_path / name)
