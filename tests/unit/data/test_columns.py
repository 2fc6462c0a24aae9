"""What a column is taken for: by its name and unit, by the user's word, and said in a table."""

import math

import numpy as np
import pytest
import torch

from herglotz.cli import main
from herglotz.cli.flags import columns_of
from herglotz.cli.parser import build_parser
from herglotz.data import Trajectories, as_trajectories, load, save
from herglotz.data.sheet import from_frame
from herglotz.data.units import in_degrees, size
from herglotz.errors import InputError
from herglotz.training.missed import ways_of_columns
from herglotz.training.run_folder import reading_in


class Frame(dict):
    """The part of a DataFrame that is used: `columns` and `frame[name]`."""

    columns = property(lambda self: list(self))


def read(folder, text, **options):
    path = folder / "motion.csv"
    path.write_text(text)
    return load(path, **options)


def rows(*columns):
    return "\n".join(",".join(map(str, row)) for row in zip(*columns, strict=True)) + "\n"


@pytest.mark.parametrize(
    ("head", "looks"),
    [
        ("speed", "speed looks like a rate: integrate a rate over time into a column of its own, or, if one of "
                  "these is a position, choose with --coordinates NAMES"),
        ("voltage", "voltage looks like an input: choose with --coordinates NAMES"),
    ],
)  # fmt: skip
def test_rates_or_inputs_alone_are_refused_with_a_remedy(tmp_path, head, looks):
    # fails if the message asks for a coordinate and does not say what became of the column that the user has, or
    # offers a speed as a position alone
    with pytest.raises(InputError, match=looks):
        read(tmp_path, f"t,{head}\n0,1\n1,2\n2,4\n")
    assert read(tmp_path, f"t,{head}\n0,1\n1,2\n2,4\n", coordinates=head).names == (head,)


def test_columns_are_named_as_their_cells_are(tmp_path):
    # fails if a column of a table is not found by the name that it has there
    data = read(
        tmp_path, "Time (s),x (m),y[m],F (N)\n" + rows([0, 1, 2], [5, 6, 7], [8, 9, 7], [1, 2, 3]),
        time="Time (s)", coordinates=["y[m]", "x (m)"], drop="F (N)",
    )  # fmt: skip
    assert (data.names, data.u) == (("y", "x"), None)


def test_brackets_that_tell_columns_apart_are_no_units(tmp_path):
    # fails if two columns become one that comes twice; or if a table with an index and numbers of rows is refused
    assert read(tmp_path, "t,x (raw),x (kept)\n0,1,1\n1,2,1\n2,2,4\n").names == ("x (raw)", "x (kept)")
    assert read(tmp_path, ",index,t,x\n0,0,0,1\n1,1,1,2\n2,2,2,2\n").names == ("x",)
    with pytest.raises(InputError, match="the column 'x' comes twice"):
        read(tmp_path, "t,x[m],x[mm]\n0,1,1\n1,2,1\n2,2,4\n")


def test_headers_of_loggers(tmp_path):
    # fails if a unit in round brackets hides the time, a name without a blank before them loses a part, or a table
    # that pandas has written with the numbers of its rows is refused
    data = read(tmp_path, ",Time (ms),Angle (deg),Run\n0,0,1,a\n1,10,2,a\n2,20,3,a\n")
    assert (data.names, data.units, data.time_unit, data.degrees) == (("Angle",), ("rad",), "s", ("Angle",))
    assert [role for _, role, _ in data.columns] == ["left aside", "time", "coordinate", "trajectory"]
    assert read(tmp_path, "t,x(1),x(2)\n0,1,1\n1,2,1\n2,2,4\n").names == ("x(1)", "x(2)")
    with pytest.raises(InputError, match=r"column 2: '' is not a header cell; .*, and delete lines above the header"):
        read(tmp_path, "t,\n0,1\n1,2\n2,2\n")


def test_degrees_and_milliseconds(tmp_path):
    # fails if degrees are fitted as lengths, if an angle is not unwrapped, or if 300 ms are not the float 0.3
    data = read(tmp_path, "t[ms],theta[deg]\n0,170\n100,-175\n300,-160\n")
    assert (data.units, data.angles, data.time_unit) == (("rad",), (True,), "s")
    assert data.t.tolist() == [0, 0.1, 0.3]
    torch.testing.assert_close(data.q[:, 0], torch.tensor([170.0, 185.0, 200.0]).double() * math.pi / 180)


@pytest.mark.parametrize(
    "head", ["Winkel [Grad]", "Winkel_Grad", "angle [degrés]", "ángulo [grados]", "angolo [gradi]"]
)
def test_degrees_have_a_name_in_each_language(tmp_path, head):
    # fails if a pendulum in Grad is a length of 25, which no warning says
    path = tmp_path / "a.csv"
    path.write_text(f"t [s],{head}\n" + "".join(f"{k / 10},{25 - k}\n" for k in range(9)), encoding="utf-8")
    data = load(path)
    assert (data.units, data.angles) == (("rad",), (True,))
    assert float(data.q[0, 0]) == pytest.approx(math.radians(25))


@pytest.mark.parametrize(("head", "name"), [("winkel [grad]", "winkel"), ("auslenkung_grad", "auslenkung")])
def test_grad_is_taken_for_degrees_with_a_word(tmp_path, capsys, head, name):
    # fails if a pendulum in grad is a length of 25, or that a fourth of a turn has 90 of them is not said
    rows = "".join(f"{k / 10},{25 - k},{k**2}\n" for k in range(9))
    (tmp_path / "a.csv").write_text(f"t [s],{head},temp_grad\n{rows}")
    data = load(tmp_path / "a.csv")
    assert (data.names, data.units, data.angles, data.degrees) == ((name,), ("rad",), (True,), (name,))
    assert float(data.q[0, 0]) == pytest.approx(math.radians(25))
    said = f"warning: a.csv: {name} in grad: taken for degrees, 360 in a turn; with 400 in a turn, write gon"
    assert said in capsys.readouterr().err


def test_degrees_are_reported_and_written_back(tmp_path):
    # fails if a file in degrees is written in radians, the archive forgets what the columns were, or a table written
    # in degrees is read as another motion
    data = read(tmp_path, "t,theta[deg],x,F[N]\n" + rows([0, 1, 2], [10, 20, 40], [1, 2, 3], [0, 1, 0]))
    assert data.degrees == ("theta",)
    save(tmp_path / "a.npz", data)
    again = load(tmp_path / "a.npz")
    assert again.columns == data.columns
    assert (again.degrees, again.input_labels) == (("theta",), (("F", "N"),))
    save(tmp_path / "b.csv", in_degrees(data, data.degrees))
    assert "theta[deg]" in (tmp_path / "b.csv").read_text()
    torch.testing.assert_close(load(tmp_path / "b.csv").q, data.q, rtol=1e-15, atol=0)
    assert [size(0.1, "rad", True), size(0.1, "rad"), size(2.0, "1")] == ["0.1 rad = 5.73 deg", "0.1 rad", "2"]


def test_dates(tmp_path):  # fails if a date is refused, or its fractions of a second are lost
    text = "timestamp,x\n2026-03-01 23:59:59.50,1\n2026-03-01T23:59:59.75,2\n2026-03-02 00:00:01,3\n"
    data = read(tmp_path, text)
    assert (data.t.tolist(), data.time_unit) == ([0, 0.25, 1.5], "s")
    assert "date, converted to s" in data.table()
    with pytest.raises(InputError, match=r"row 3: .* differ in having a time zone"):
        read(tmp_path, "time,x\n2026-03-01T10:00:00Z,1\n2026-03-01T10:00:01,2\n2026-03-01T10:00:02,2\n")


def test_the_users_word_counts(tmp_path):  # fails if a column keeps the role of its name against the user's word
    text = "clock,t,run,a,b,u,F\n" + rows([0, 1, 2], [9, 9, 9], list("zzz"), [1, 2, 3], [4, 5, 6], [7, 8, 9], [1, 1, 1])
    data = read(tmp_path, text, time="clock", group="run", inputs="b", drop="a", coordinates=["u"])
    assert (data.t.tolist(), data.q[:, 0].tolist()) == ([0, 1, 2], [7, 8, 9])
    assert data.u is not None
    assert data.u.tolist() == [[4], [5], [6]]
    assert read(tmp_path, text, time="clock", inputs=(), drop=["run"]).u is None
    with pytest.raises(InputError, match=r"there is no column 'c'; the columns are clock, t, run, a, b, u, F"):
        read(tmp_path, text, drop="c")


def test_every_load_prints_what_it_took_the_columns_for(tmp_path, capsys):
    # fails if a column is left out of the table, a conversion is not said, or the table soils stdout
    read(tmp_path, "t[ms],theta[deg],theta_dot,tau[Nm]\n" + rows([0, 1, 2], [1, 2, 3], [0, 0, 0], [4, 5, 6]))
    out, err = capsys.readouterr()
    assert out == ""
    assert [line.split() for line in err.splitlines()] == [
        ["motion.csv:"],
        ["column", "is", "taken", "for", "unit"],
        ["t", "time", "ms,", "converted", "to", "s"],
        ["theta", "angle", "deg,", "converted", "to", "rad"],
        ["theta_dot", "left", "aside", "-"],
        ["tau", "input", "Nm"],
    ]
    read(tmp_path, "t,theta\n0,1\n1,2\n2,3\n")
    assert "theta   coordinate    - (an angle in rad? --angles theta)" in capsys.readouterr().err
    # fails if joints that torques turn are lengths without a word
    data = read(tmp_path, "t,q1,q2,tau1\n" + rows([0, 1, 2], [1, 2, 3], [2, 1, 3], [4, 5, 6]))
    assert "q2      coordinate    - (an angle in rad? --angles q2)" in capsys.readouterr().err
    assert ways_of_columns(data) == ["--angles q1,q2, where these are angles in rad"]
    assert not ways_of_columns(read(tmp_path, "t,q1,F1\n" + rows([0, 1, 2], [1, 2, 3], [4, 5, 6]), show=False))
    capsys.readouterr()
    read(tmp_path, "t,x\n0,1\n1,2\n2,3\n", show=False)
    assert capsys.readouterr().err == ""


def test_flags_reach_the_reader(tmp_path, capsys):
    # fails if a flag of the command line is dropped on the way, or a run that had the flag cannot be opened
    path = tmp_path / "motion.csv"
    path.write_text("clock,a,b\n0,1,2\n1,2,3\n")
    flags = ["--time", "clock", "--coordinates", "a", "--inputs", "none", "--drop", "b", "--group", "lap"]
    for command in (
        ["fit", str(path), "--out", str(tmp_path / "run")],
        ["select", str(path), "--out", str(tmp_path)],
        ["plot", str(path), "--out", str(tmp_path)],
    ):
        assert main([*command, *flags]) == 2
        assert "there is no column 'lap'; the columns are clock, a, b" in capsys.readouterr().err
        more = ["--angles", "a", "--degrees", "b,c", "--polar", "x1,y1", "--polar", "x2,-y2"]
        taken = columns_of(build_parser().parse_args([*command, *flags, *more]))
        names = {"coordinates": ["a"], "inputs": [], "drop": ["b"], "angles": ["a"], "degrees": ["b", "c"]}
        assert taken == {"time": "clock", "group": "lap", **names, "polar": ["x1,y1", "x2,-y2"]}
        assert reading_in({"reading": taken}, "config.json") == taken


def test_columns_are_of_tables(tmp_path):  # fails if a flag is ignored where it has no meaning
    np.savez(tmp_path / "a.npz", t=np.arange(4.0), q=np.arange(4.0))
    with pytest.raises(InputError, match=r"columns are chosen in a table, such as a csv file; this is arrays t, q"):
        load(tmp_path / "a.npz", drop="q")


def test_a_frame_is_read_like_a_csv_file():  # fails if a DataFrame's columns get other roles than a file's
    frame = Frame({"time": np.arange(6) % 3, "lap": list("aaabbb"), "x[m]": np.arange(6.0), "torque": np.ones(6)})
    from herglotz.data.csv_columns import Wanted

    data = from_frame(frame, Wanted(group="lap"))
    assert (data.lengths, data.names, data.units) == ((3, 3), ("x",), ("m",))
    assert data.u is not None
    frame["time"] = np.array(
        ["2026-01-01T00:00:00", "2026-01-01T00:00:02", "2026-01-01T00:00:03"] * 2, "datetime64[ns]"
    )
    assert from_frame(frame, Wanted(group="lap")).t.tolist() == [0, 2, 3, 0, 2, 3]
    frame["x[m]"][4] = np.inf
    with pytest.raises(InputError, match=r"DataFrame, row 4, column 'x': inf is not finite; drop that row"):
        from_frame(frame, Wanted(group="lap"))
    frame["x[m]"][4] = np.nan
    left = from_frame(frame, Wanted(group="lap"))
    assert left.lengths == (3,)
    assert "row 3: of the 3 rows from here, 2 have a value in every column" in left.notes[0]
    frame["torque"][4], frame["x[m]"][4] = np.nan, 4
    assert from_frame(frame, Wanted(group="lap")).u.tolist() == [[1]] * 6  # type: ignore[union-attr]
    frame["torque"][4] = np.inf
    with pytest.raises(InputError, match=r"DataFrame, row 4, column 'torque': inf is not finite; drop that row"):
        from_frame(frame, Wanted(group="lap"))


def test_irregular_sampling_is_called_so():  # fails if every long step of an irregular recording is counted as a gap
    h = np.random.default_rng(0).uniform(0.5, 1.5, 200)
    irregular = Trajectories.of(h.cumsum(), np.arange(200.0))
    assert irregular.irregular
    assert irregular.summary().endswith(f"irregular steps, {h[1:].min():.3g} to {h[1:].max():.3g} s")
    clock = 0.01 * (1 + 0.01 * np.random.default_rng(0).standard_normal(200))  # jitter of one per cent, and two gaps
    t = np.delete(clock.cumsum(), [50, 120, 121])
    regular = Trajectories.of(t, np.arange(197.0))
    assert not regular.irregular
    assert regular.summary().endswith("2 gaps")


def test_columns_mean_what_they_meant_in_another_recording(tmp_path):
    # fails if `volts`, which a fit was told to be its input, is a coordinate of the next file, or the order of inputs,
    # coordinates and angles is the file's
    text = "t,phi,x[m],volts,amps\n" + rows([0, 1, 2], [3, 3.1, -3.1], [5, 6, 7], [8, 9, 7], [1, 2, 4])
    told = read(tmp_path, text, inputs=["volts", "amps"], angles="phi")
    again = "t,amps,x[m],phi,volts,extra\n" + rows(
        [0, 1, 2], [1, 2, 4], [5, 6, 7], [3, 3.1, -3.1], [8, 9, 7], [0, 0, 0]
    )
    found = read(tmp_path, again, like=told, drop="extra")
    assert (found.names, found.angles, found.units) == (told.names, told.angles, told.units)
    assert torch.equal(found.u, told.u)  # type: ignore[arg-type]
    assert torch.equal(found.q, told.q)  # unwrapped across π
    ramp = np.arange(3.0)
    frame = {"t": ramp, "volts": ramp, "phi": ramp, "x[m]": ramp, "amps": ramp}
    assert as_trajectories(frame, like=told).angles == (True, False)
    assert read(tmp_path, again, like=told, inputs="extra").u[:, 0].tolist() == [0, 0, 0]  # type: ignore[index]


def test_an_angle_of_another_recording_in_degrees_is_not_assumed(tmp_path):
    # fails if numbers without a unit become radians because the first file, in degrees, was converted to them
    told = read(tmp_path, "t,phi[deg]\n0,10\n1,20\n2,30\n")
    assert read(tmp_path, "t,phi\n0,10\n1,20\n2,30\n", like=told).units == ("1",)


def test_a_column_has_one_role(tmp_path):
    # fails if --coordinates x,F --inputs F makes F a coordinate, and says nothing of the input that was asked for
    path = tmp_path / "a.csv"
    path.write_text("t,x,F\n0,1,2\n1,2,3\n2,4,5\n")
    with pytest.raises(InputError, match="row 1: 'F' is named for both coordinates and inputs; a column has one role"):
        load(path, coordinates=["x", "F"], inputs="F", show=False)
