"""The csv format: roles of columns, messages, exact round trips, and no surprise on any input."""

import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given, settings, strategies as st

from herglotz.data import Trajectories, read_csv, write_csv
from herglotz.data.csv_columns import Wanted
from herglotz.data.marks import marks_of
from herglotz.errors import InputError

GOOD = "trajectory,t[s],q[rad]\n0,0,0.0\n0,1,0.1\n0,2,0.2\n1,0,1.0\n1,1,1.1\n1,3,1.2\n"


def read(folder: Path, text: str | bytes, **options) -> Trajectories:
    path = folder / "data.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    angles = options.pop("angles", None)
    found = read_csv(path, Wanted(**options))
    return found if angles is None else found.with_angles(angles)


def rich() -> Trajectories:
    """Two trajectories of two coordinates with s, p, u and numbers that need all 17 digits."""
    g = torch.Generator().manual_seed(0)
    x = torch.randn(9, 5, generator=g, dtype=torch.float64) * 1e-7
    t = torch.cat([torch.arange(4).double() / 3, 1e9 + torch.arange(5).double() / 7])
    u = torch.stack([x[:, 0], 1 / x[:, 1]], 1)
    labels = {"names": ("theta", "x"), "units": ("rad", "m"), "angles": (True, False), "time_unit": "ms"}
    return replace(Trajectories.of(t, x[:, :2], (4, 5), s=x[:, 2], p=x[:, 3:], u=u), **labels)


def test_reads_groups_units_and_values(tmp_path):  # fails if rows are grouped wrongly or a unit is lost
    data = read(tmp_path, GOOD)
    assert (data.lengths, data.names, data.units, data.angles) == ((3, 3), ("q",), ("rad",), (True,))
    assert data.time_unit == "s"
    assert data.q[:, 0].tolist() == [0.0, 0.1, 0.2, 1.0, 1.1, 1.2]
    assert data.t.tolist() == [0, 1, 2, 0, 1, 3]
    assert (data.s, data.p, data.u) == (None, None, None)


def test_interleaved_trajectories(tmp_path):  # fails if rows must be contiguous or groups are mixed
    data = read(tmp_path, "trial,time,x[m]\nb,0,1\na,0,5\nb,1,2\na,1,6\nb,2,3\na,2,7\n")
    assert data.q[:, 0].tolist() == [1, 2, 3, 5, 6, 7]


def test_roles(tmp_path):  # fails if a velocity is taken for a coordinate, p is not matched by name, or u is lost
    head = "u_1,p_x,y[m],velocity,Time[ms],x_dot,x[rad],v,p_y,s,torque\n"
    data = read(tmp_path, head + "".join(",".join(str(10 * k + i) for i in range(11)) + "\n" for k in range(3)))
    assert (data.names, data.units, data.angles, data.time_unit) == (("y", "x"), ("m", "rad"), (False, True), "ms")
    assert data.t.tolist() == [4, 14, 24]
    assert data.q[0].tolist() == [2, 6]
    assert data.p is not None
    assert data.s is not None
    assert data.u is not None
    assert data.p[0].tolist() == [8, 1]
    assert data.s.tolist() == [9, 19, 29]
    assert data.u[0].tolist() == [0, 10]


def test_what_spreadsheets_write(tmp_path):  # fails if a BOM, CRLF, quotes, blank lines, spaces or comments are refused
    text = '\ufeff# made by hand\r\n\r\n"t[s]" , "q [rad]"\r\n0,"1.5"\r\n# note\r\n1, 2\r\n2,3\r\n\r\n'
    data = read(tmp_path, text)
    assert (data.names, data.units) == (("q",), ("rad",))
    assert data.q[:, 0].tolist() == [1.5, 2, 3]
    assert read(tmp_path, "t,q\r0,1\r1,2\r2,3\r").q[:, 0].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("t,q\n0.D+00,1.5D+00\n1.D+00,-2.5d-03\n2.D+00,.5D+02\n", [1.5, -2.5e-3, 50]),
        ("t q\n0.0d+00 1.5d+00\n1.0d+00 -2.5D-03\n2.0d+00 5.0D-101\n", [1.5, -2.5e-3, 5e-101]),
    ],
)
def test_exponents_of_fortran(tmp_path, text, values):
    # fails if d in lower case, a number without digits on one side of its point, or an exponent of three digits is not
    # read, or if the sign of an exponent is lost
    data = read(tmp_path, text)
    assert (data.t.tolist(), data.q[:, 0].tolist()) == ([0, 1, 2], values)


@pytest.mark.parametrize("cell", ["3D", "1D-02x", "1.5D-02x", "1.5D+1", "1.5D12", "2026-01-02D+00"])
def test_words_with_d_stay_as_they_are(tmp_path, cell):
    # fails if part of a word is taken for an exponent of Fortran, so that the message has another word than the file
    with pytest.raises(InputError, match=rf"column 'q': '{re.escape(cell)}' is not a number"):
        read(tmp_path, f"t,q\n0,1\n1,{cell}\n2,3\n")


def test_names_with_d_stay_as_they_are(tmp_path):  # fails if a name, or the label of a trial, has an E for its D
    labels = read(tmp_path, "t,x,3D-10\n" + "".join(f"{k},{k},{-k}\n" for k in range(3)))
    assert labels.names == ("x", "3D-10")  # a comma before 3D is no decimal comma
    data = read(tmp_path, "trial,t,x_3D,x_1.5D-02x\n" + "".join(f"run 2.5D-02b,{k},{k},{-k}\n" for k in range(3)))
    assert data.names == ("x_3D", "x_1.5D-02x")
    assert data.lengths == (3,)


def test_blank_trajectory_column_is_one_trajectory(tmp_path):  # fails if a blank label is an error
    assert read(tmp_path, "trajectory,t,q\n,0,1\n,1,2\n,2,3\n").lengths == (3,)


# Each line fails if that check is dropped or its message loses file, row, column, value or remedy.
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"data.csv: the file is empty; check"),
        ("\n  \n# only a comment\n", r"data.csv: there is no header; add a first line such as"),
        ("t,q\n", r"data.csv: there is a header but no samples; add at least 3 rows"),
        ("0,1\n1,2\n", r"data.csv, row 1: the header is missing \(only numbers there\); add a first line"),
        ("t,q\n0;1\n", r"data.csv, row 2: 1 cells where the header has 2; correct"),
        ("t;q\n0;1,5\n1;2.5\n", r"data.csv, row 3: '2.5' beside '1,5' in row 2; write all decimals with one sign"),
        ("a,q\n0,1\n", r"data.csv, row 1: no time column; the columns are a, q: choose one with --time NAME"),
        ("t,time,q\n0,1,2\n", r"data.csv, row 1: two time columns, t and time; choose one with --time NAME"),
        ("t,v\n0,1\n", "data.csv, row 1: no coordinate column, only t, v; v looks like a rate"),
        ("t,q,q\n0,1,2\n", r"data.csv, row 1: the column 'q' comes twice; rename or delete one"),
        ("t,q[rad\n0,1\n", r"data.csv, row 1, column 2: 'q\[rad' is not a header cell; write name or name\[unit\]"),
        ("t,,q\n0,1,2\n", r"data.csv, row 1, column 2: '' is not a header cell"),
        ("trajectory,trial,t,q\n0,0,1,2\n", r"data.csv, row 1: both a column trajectory and a column trial; keep one"),
        ("t,a,b,p_a,p_c\n0,1,2,3,4\n", r"row 1: momentum columns p_a, p_c are not p_a, p_b; rename or delete them"),
        ("t,q\n0,1\n1,abc\n2,3\n", r"data.csv, row 3, column 'q': 'abc' is not a number; correct or delete the row"),
        ("t,q\n\n# x\n0,1\n,2\n2,3\n", r"data.csv, row 5, column 't': a blank cell is not a number; correct or delete"),
        ("t,q,a\n0,1,ok\n1,2,no\n", r"row 2, column 'a': 'ok' is not a number; write numbers, .* --group a "),
        ("t,q\n1:00,1\n2:00,2\n", r"row 2, column 't': '1:00' is not a number; write numbers, or dates such"),
        ("t,q,a\ns,5,m\n1,2,3\n", r"row 2, column 't': 's' is not a number; correct or delete the row"),
        ("t,q\n0,1\n1_0,2\n", r"data.csv, row 3, column 't': '1_0' is not a number"),
        ("t,q\n0,1\nNaN,2\n2,3\n", r"data.csv, row 3, column 't': 'NaN' is not finite; correct or delete the row"),
        (
            "t,q,x\n0,1,\n1,2,\n2,3,\n3,,4\n",
            r"row 2: of the 4 rows from here, 0 have a value in every column, at least 3 are needed; column 'x' has "
            r"the most gaps: leave it out with --drop x \(drop= in Python\), or fill it in",
        ),
        ("t,q\n0,1\n1,1e999\n2,3\n", r"data.csv, row 3, column 'q': '1e999' is not finite"),
        ("t,q\n0,1\n1,2,3\n", r"data.csv, row 3: 3 cells where the header has 2; correct or delete the row"),
        (
            "t,q\n0,1\n2,2\n1,3\n",
            r"row 4, column 't': 1.0 does not increase on 2.0 in row 3; sort the rows, delete one, or number the traj",
        ),
        (
            GOOD + "x,0,9\ny,0,9\nz,0,9\n",
            r"data.csv, row 8, column 'trajectory': 'x' has 1 sample, at least 3 are needed; delete it",
        ),
        ("t,q\n0,1\n1,2\n", r"data.csv, row 2: the file has 2 samples, at least 3 are needed; add rows"),
        ("trajectory,t,q\n1,0,0\n,1,1\n", r"row 3, column 'trajectory': blank, but other rows name a trajectory; fill"),
        (b"t,q\n0,1\n\xff,2\n", r"data.csv, row 3: not UTF-8 text \(byte 0xff\); save the file as UTF-8"),
        ("t,q\n0,1\n1," + "z" * 500 + "\n", r"column 'q': 'z{40}…' is not a number"),
        ("t,q\n0,1\n1,a\x0bb\x1b\n", r"column 'q': 'a\\x0bb\\x1b' is not a number"),
    ],
)
def test_every_mistake_has_its_message(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, text)
    assert str(tmp_path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_no_coordinates(tmp_path):  # fails if a table whose coordinates are none of its columns is read
    with pytest.raises(InputError, match=r"no coordinate column"):
        read(tmp_path, GOOD, coordinates=())


def test_absent_file_and_folder(tmp_path):  # fails if an OSError escapes
    with pytest.raises(InputError, match=r"none.csv: there is no such file; check the name"):
        read_csv(tmp_path / "none.csv")
    with pytest.raises(InputError, match=r"is a folder, not a file; name one file in it"):
        read_csv(tmp_path)
    with pytest.raises(InputError, match=r"cannot be read \("):
        read_csv(tmp_path / "nul\0.csv")


def test_round_trip_is_exact(tmp_path):  # fails if a digit, a label or an optional array is lost
    data = rich()
    write_csv(tmp_path / "a.csv", data, comments=["two\nlines", "and one"])
    assert (tmp_path / "a.csv").read_text().startswith("# two\n# lines\n# and one\ntrajectory,t[ms],theta[rad],x[m],s,")
    assert read_csv(tmp_path / "a.csv").digest() == data.digest()
    unnamed = replace(data, time_unit="1")  # fails if [1] is read as seconds
    write_csv(tmp_path / "a.csv", unnamed)
    assert read_csv(tmp_path / "a.csv").digest() == unnamed.digest()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=3, max_size=9))
@example([0.0, 5e-324, -0.0, 1.7976931348623157e308, 0.1])
def test_any_float_survives(values):  # fails for subnormals, -0.0 or 1e308 printed inexactly
    # 0, 0, 0, 0, 1e20, 1e20, 1 has a mark of missing readings.
    assume(not marks_of(np.array(values), np.ones(len(values) - 1, bool)))
    data = Trajectories.of(range(len(values)), values)
    with tempfile.TemporaryDirectory() as folder:
        write_csv(Path(folder) / "a.csv", data)
        assert read_csv(Path(folder) / "a.csv").digest() == data.digest()


@pytest.mark.parametrize("name", ["t", "s", "v", "p_x", "u", "torque", "theta_dot", "trial", "a,b", "a[b", " a", '"'])
def test_names_that_a_header_cannot_hold(tmp_path, name):  # fails if such a file is written and read as something else
    with pytest.raises(InputError, match=r"a.csv: .*(rename)"):
        write_csv(tmp_path / "a.csv", Trajectories.of([0, 1, 2], [0, 1, 2], names=(name,)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("unit", ["m,s", "m]", " m"])
def test_units_that_a_header_cannot_hold(tmp_path, unit):  # fails if the unit comes back changed
    with pytest.raises(InputError, match="rename"):
        write_csv(tmp_path / "a.csv", Trajectories.of([0, 1, 2], [0, 1, 2], units=(unit,)))


def test_writing_into_no_folder(tmp_path):  # fails if an OSError escapes
    with pytest.raises(InputError, match=r"none/a.csv: cannot be written \(No such file"):
        write_csv(tmp_path / "none" / "a.csv", rich())


def reads_or_explains(content: bytes) -> None:
    """Read these bytes as csv: a set of trajectories or a one-line InputError, nothing else."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "x.csv"
        path.write_bytes(content)
        message = "fine"
        try:
            read_csv(path)
        except InputError as error:
            message = str(error)
        assert len(message.splitlines()) == 1


CELL = st.one_of(
    st.sampled_from(
        ["t", "q[rad]", "x", "s", "p", "0", "1", "2", "3.5", "-1e308", "1e308", "nan", "", "trial", '"', "#", "\r"]
    ),
    st.text(max_size=5),
)
TABLE = st.lists(st.lists(CELL, min_size=1, max_size=4).map(",".join), max_size=8).map("\n".join)
BODY = st.lists(st.lists(st.floats(), min_size=3, max_size=3), max_size=6).map(
    lambda rows: "t,q[rad],x\n" + "\n".join(",".join(map(str, row)) for row in rows)
)


@settings(max_examples=150, deadline=None)
@given(st.one_of(st.binary(max_size=80), TABLE.map(lambda x: x.encode("utf-8", "replace")), BODY.map(str.encode)))
def test_nothing_but_input_error(content):  # fails if any bytes raise another exception or a message of two lines
    reads_or_explains(content)
