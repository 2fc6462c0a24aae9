"""Tables as spreadsheets, loggers and numpy write them, and rows in which a sample is missing."""

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories, load, read_csv, save
from herglotz.data.csv_columns import Wanted
from herglotz.data.csv_format import cells_of
from herglotz.errors import InputError

T = np.arange(6) * 0.5
X = np.array([1.25, -0.5, 3e-3, 4.0, -5.125, 6.0])


def written(tmp_path, text, name="a.csv", encoding="utf-8"):
    (tmp_path / name).write_bytes(text.encode(encoding))
    return tmp_path / name


def table(separator, decimal=".", header=("t[s]", "x[m]")):
    rows = [header, *zip(map(str, T), map(str, X), strict=True)]
    return "".join(separator.join(row).replace(".", decimal) + "\r\n" for row in rows)


@pytest.mark.parametrize(
    ("separator", "decimal", "note"),
    [
        (",", ".", None),
        (";", ".", "columns are separated by ';'"),
        (";", ",", "columns are separated by ';', and decimals by commas"),
        ("\t", ".", "columns are separated by tabs"),
        ("\t", ",", "columns are separated by tabs, and decimals by commas"),
        ("  ", ".", "columns are separated by spaces"),
    ],
)
def test_separators_and_decimals(tmp_path, separator, decimal, note):
    # fails if a table of a European spreadsheet is refused, read with other numbers, or nothing is said of it
    data = load(written(tmp_path, table(separator, decimal)))
    assert data.t.tolist() == T.tolist()
    assert data.q[:, 0].tolist() == X.tolist()
    assert (data.names, data.units) == (("x",), ("m",))
    assert data.notes == (() if note is None else (note,))
    assert note is None or f"  {note}" in data.table().splitlines()


@pytest.mark.parametrize("delimiter", [",", " ", ";"])
def test_a_header_as_numpy_writes_it(tmp_path, delimiter):
    # fails if the header that numpy.savetxt puts behind # is skipped as a comment
    header = delimiter.join(["t", "x[m]"])
    np.savetxt(tmp_path / "a.csv", np.c_[T, X], delimiter=delimiter, header=header)
    data = load(tmp_path / "a.csv")
    assert data.q[:, 0].tolist() == X.tolist()
    assert data.notes[0] == "the header is row 1, behind #"
    with pytest.raises(InputError, match="the header is missing"):
        load(written(tmp_path, "# made by hand, on Monday, at noon\n" + "0,1\n1,2\n2,3\n"))


@pytest.mark.parametrize("name", ["a.txt", "a.tsv", "a.dat"])
def test_tables_with_other_endings(tmp_path, name):  # fails if only .csv is read as a table
    data = load(written(tmp_path, table("\t"), name), time="t")
    assert data.q[:, 0].tolist() == X.tolist()


def test_units_in_the_letters_of_windows(tmp_path):
    # fails if the ° or ö of a drive that does not write UTF-8 is refused, or any other such byte is let in
    text = table(";", ",", ("t (µs)", "Winkel (°)"))
    assert load(written(tmp_path, "t,Länge\n0,1\n1,2\n2,3\n", encoding="cp1252")).names == ("Länge",)
    data = load(written(tmp_path, text, encoding="cp1252"))
    assert data.digest() == load(written(tmp_path, text)).digest()
    assert (data.degrees, data.time_unit) == (("Winkel",), "s")
    with pytest.raises(InputError, match=r"row 1: not UTF-8 text \(byte 0xb3\)"):
        load(written(tmp_path, "t,długość\n0,1\n1,2\n2,3\n", encoding="cp1250"))


@pytest.mark.parametrize("gap", ["", "nan", "NaN", "NA", "null", "#N/A"])
def test_rows_without_a_value_are_left_out(tmp_path, gap):
    # fails if a missing sample stops the reading, becomes a number, or goes without a word
    data = load(written(tmp_path, f"t,x,y\n0,{gap},0\n1,1,1\n2,2,2\n3,{gap},{gap}\n4,4,4\n5,5,{gap}\n"))
    assert data.t.tolist() == [1, 2, 4]
    assert data.q.tolist() == [[1, 1], [2, 2], [4, 4]]
    assert data.observed is None
    assert data.notes == ("3 rows are left out, without a value: the first is row 2, column 'x'",)


def test_rows_left_out_of_several_recordings(tmp_path):
    # fails if rows are left out of another recording, or a first row without a value is taken for a start
    rows = [f"{run},{k},{'' if k in (0, 4) else 10 * run + k}" for k in range(6) for run in (1, 2)]
    data = load(written(tmp_path, "\n".join(["run,t,x", *rows]) + "\n,,\n"))
    assert data.lengths == (4, 4)
    assert data.q[:, 0].tolist() == [11, 12, 13, 15, 21, 22, 23, 25]


def test_the_inputs_of_a_missing_sample_still_act(tmp_path):
    # fails if the input at a row without a position is lost: the step over it has the mean of both
    data = load(written(tmp_path, "t,x,u\n0,0,1\n1,,3\n2,2,5\n3,3,7\n4,4,9\n"))
    assert data.u is not None
    assert data.t.tolist() == [0, 2, 3, 4]
    assert data.u[:, 0].tolist() == [2, 5, 7, 9]
    held = load(written(tmp_path, "# hold: zero\nt,x,u\n0,0,1\n1,,3\n2,2,5\n3,3,7\n4,4,9\n"))
    assert held.hold == "zero"
    assert held.u is not None
    assert torch.equal(held.u, data.u)


@pytest.mark.parametrize(
    ("header", "name", "unit", "time_unit"),
    [
        ("t,angle_deg", "angle", "deg", "s"),
        ("time_ms,angle_rad", "angle", "rad", "ms"),
        ("t_s,theta_m", "theta_m", "1", "s"),
        ("t,x_deg[m]", "x_deg", "m", "s"),
    ],
)
def test_units_at_the_end_of_a_name(tmp_path, header, name, unit, time_unit):
    # fails if degrees that only the name tells are taken for radians or metres, or milliseconds for seconds
    data = read_csv(written(tmp_path, header + "\n0,1\n1,2\n2,3\n"))
    assert (data.names, data.units, data.time_unit) == ((name,), (unit,), time_unit)


def test_names_with_units_at_their_end_stay_apart(tmp_path):
    # fails if angle_deg beside angle_rad is one column twice, or the whole name cannot be told
    path = written(tmp_path, "t,angle_deg,angle_rad,gyro_deg_s\n0,1,2,3\n1,2,3,4\n2,3,4,5\n")
    data = read_csv(path, Wanted(drop="angle_rad"))
    assert (data.names, data.units) == (("angle_deg",), ("deg",))
    assert ("gyro", "left aside", "deg/s") in data.columns
    path = written(tmp_path, "t,angle_deg\n0,1\n1,2\n2,3\n")
    for coordinate in ("angle_deg", "angle"):
        assert read_csv(path, Wanted(coordinates=coordinate)).names == ("angle",)


def test_names_that_look_like_units_are_written_and_read(tmp_path):
    # fails if the momentum of x_deg comes back as that of x
    x = torch.arange(6.0, dtype=torch.float64).reshape(3, 2)
    data = Trajectories.of([0, 1, 2], x, p=x, names=("x_deg", "t_ms"))
    save(tmp_path / "a.csv", data)
    assert load(tmp_path / "a.csv").digest() == data.digest()


def test_a_folder_of_recordings(tmp_path, capsys):
    # fails if a folder is refused, its files are joined in another order, or other files of it are read
    folder = tmp_path / "lab"
    folder.mkdir()
    for k, name in enumerate(["b.csv", "a.tsv"]):
        (folder / name).write_text("t\tx_deg\n" + "".join(f"{i}\t{i + 10 * k}\n" for i in range(3)))
    (folder / "notes.md").write_text("nothing")
    data = load(folder)
    assert data.lengths == (3, 3)
    assert data.q[:, 0].rad2deg().tolist() == pytest.approx([10, 11, 12, 0, 1, 2])
    lines = capsys.readouterr().err.splitlines()
    assert (lines[0], len(lines)) == ("lab:", 6)
    assert "  2 recordings: a.tsv, b.csv" in lines
    assert data.recordings == ("a.tsv", "b.csv")
    (folder / "c.csv").write_text("t,y\n0,1\n1,2\n2,3\n")
    with pytest.raises(InputError, match=r"c\.csv beside a\.tsv: sets with different names cannot be joined"):
        load(folder)


def test_recordings_have_the_names_of_files_and_groups(tmp_path):
    # fails if a message about trajectory 17 of a folder leaves it to the reader which file that is
    for name in ("a.csv", "b.csv"):
        text = "run,t,x\n" + "".join(f"{run},{i},{i * run}\n" for run in (4, 7) for i in range(3))
        (tmp_path / name).write_text(text)
    assert load(tmp_path / "a.csv").label(1) == "trajectory 1 (run 7)"
    assert load(tmp_path).recordings == ("a.csv, run 4", "a.csv, run 7", "b.csv, run 4", "b.csv, run 7")


def test_notes_on_the_files_of_a_folder_name_the_file(tmp_path):
    # fails if rows that are left out of one file read as those of any, or a note of two files stands once for both
    rows = "0;1\n1;\n2;3\n3;4\n"
    for name, text in (("a.csv", rows), ("b.csv", rows), ("c.csv", rows.replace("1;\n", "1;2\n"))):
        (tmp_path / name).write_text("t;x\n" + text)
    left_out = "a row is left out, without a value: the first is row 3, column 'x'"
    assert load(tmp_path).notes[1:] == ("columns are separated by ';'", f"a.csv: {left_out}", f"b.csv: {left_out}")


def test_folders_without_recordings(tmp_path):  # fails if an empty folder, or that of a run, ends in a traceback
    with pytest.raises(InputError, match=r"is a folder without recordings; files end in \.csv"):
        load(tmp_path)
    (tmp_path / "history.csv").write_text("stage,iteration,cost\n")
    (tmp_path / "model.pt").write_text("")
    with pytest.raises(InputError, match="is the folder of a run, not data"):
        load(tmp_path)


def test_quoted_names_between_spaces():
    # fails if spaces at the end of a line, or several side by side, make an empty cell where names have quotes
    assert cells_of('"t"  "x" ', " ") == ["t", "x"]
    assert cells_of('"a, b",c', ",") == ["a, b", "c"]


TITLES = {
    "a title": ("mass_A\n", "t,x,y", ("x", "y")),
    "a title of several words, and another": ("Pendulum, lab 2, 50 Hz\n2026\n", "Time [s],x[m],y[m]", ("x", "y")),
    "a row of units": ("Channel 1\n", "t,x,y\ns,m,m", ("x", "y")),
}


@pytest.mark.parametrize("kind", TITLES)
def test_lines_above_the_header(tmp_path, kind):
    # fails if the lines of a program that names a mass above its table are refused
    title, header, names = TITLES[kind]
    rows = "".join(f"{t},{x},{2 * x}\n" for t, x in zip(T, X, strict=True))
    data = load(written(tmp_path, f"{title}{header}\n{rows}"))
    assert (data.names, data.t.tolist(), data.q[:, 1].tolist()) == (names, T.tolist(), (2 * X).tolist())
    count = title.count("\n")
    note = f"{count} line{'s' if count > 1 else ''} above the header, which is row {count + 1}, left out"
    assert note in data.notes


BODIES = ("#multi:\n\tmass A\t\tmass_B\t\nt\tx\ty\tx\ty\n", ",mass A,,mass_B,\nt,x,y,x,y\n")


@pytest.mark.parametrize("head", BODIES)
def test_bodies_of_a_video_have_the_names_above_their_columns(tmp_path, head):
    # fails if the positions of two bodies are columns that come twice, or if one body has the name of the other
    rows = [(0.1 * k, k, k**2, 2 + k, 3 * k) for k in range(9)]
    text = head + "".join(("\t" if "\t" in head else ",").join(map(str, row)) + "\n" for row in rows)
    data = load(written(tmp_path, text), show=False)
    assert data.names == ("mass_A_x", "mass_A_y", "mass_B_x", "mass_B_y")
    assert data.q[2].tolist() == [2, 4, 4, 6]
    assert any("names the bodies of the columns below" in note for note in data.notes)


def test_names_that_come_twice_below_one_title_are_refused(tmp_path):
    # fails if a title of the whole table makes two names of one
    with pytest.raises(InputError, match="'x' comes twice"):
        load(written(tmp_path, "my pendulum\nt,x,x\n" + "".join(f"{k},{k},{2 * k}\n" for k in range(9))), show=False)
