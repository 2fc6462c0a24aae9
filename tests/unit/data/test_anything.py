"""Recordings as users have them: arrays, lists, Series, DataFrames, paths."""

import sys

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories, as_trajectories, save
from herglotz.errors import InputError

T = np.array([0.0, 0.1, 0.3, 0.4])
Q = np.array([[1.0, 5.0], [2.0, 6.0], [3.0, 7.0], [4.0, 8.0]])


class Series(list):
    """The part of a pandas Series that is used."""

    def __init__(self, values, index, name):
        super().__init__(values)
        self.index, self.name = np.asarray(index), name  # type: ignore[assignment]


class Frame(dict):
    """The part of a DataFrame that is used."""

    columns = property(lambda self: list(self))


def test_one_array(tmp_path):  # fails if times, names, angles or inputs of an array are lost
    one = as_trajectories(Q, time=T, coordinates=("a", "b"), angles="b", inputs=T * 2)
    assert (one.lengths, one.names, one.angles, one.units) == ((4,), ("a", "b"), (False, True), ("1", "rad"))
    assert one.q.tolist() == Q.tolist()
    assert one.t.tolist() == T.tolist()
    assert one.u is not None
    assert one.u[:, 0].tolist() == (T * 2).tolist()
    assert as_trajectories([1, 2, 4], h=0.5).t.tolist() == [0, 0.5, 1]
    assert as_trajectories(torch.tensor(Q, requires_grad=True), h=0.5, angles=True).angles == (True, True)
    save(tmp_path / "a.npz", one)
    assert as_trajectories(str(tmp_path / "a.npz")).digest() == one.digest()


def test_no_inputs_means_none(tmp_path):  # fails if inputs=() of a file is forgotten, and forces are fitted unasked
    (tmp_path / "a.csv").write_text("t,x,force\n" + "".join(f"{t},{x},{y}\n" for t, (x, y) in zip(T, Q, strict=True)))
    assert as_trajectories(tmp_path / "a.csv").u is not None
    for data in (tmp_path / "a.csv", {"t": T, "x": Q[:, 0], "force": Q[:, 1]}):
        assert as_trajectories(data, inputs=()).u is None
        x, force = (np.array([name]) for name in ("x", "force"))  # as pandas' columns are
        assert as_trajectories(data, coordinates=x, inputs=force).names == ("x",)  # pyright: ignore[reportArgumentType]


def test_angles_are_continuous():  # fails if an array's angle keeps a jump of 2π, which would read as a motion
    assert as_trajectories([3.0, -3.0, -2.9], h=1, angles=True).q[1:, 0].tolist() == pytest.approx(
        [3.2832, 3.3832], 1e-4
    )


@pytest.mark.parametrize("several", [[Q, Q[:3]], [Q.tolist(), Q[:3].tolist()], (torch.tensor(Q), Q[:3])])
def test_a_list_is_several_recordings(
    several,
):  # fails if two recordings are joined into one, or rows become recordings
    assert as_trajectories(several, h=0.1).lengths == (4, 3)
    assert as_trajectories(np.stack([Q, Q]), h=0.1).lengths == (4, 4)
    one = Trajectories.of(T, Q)
    assert as_trajectories([one, one]).lengths == (4, 4)


def test_tables():  # fails if a Series' index is not its time, or a DataFrame's options are dropped
    found = as_trajectories(Series([1, 2, 3, 4], T, "theta"), angles=True)
    assert (found.names, found.t.tolist(), found.angles) == (("theta",), T.tolist(), (True,))
    assert as_trajectories({"t": T.tolist(), "x": Q[:, 0]}).q[:, 0].tolist() == Q[:, 0].tolist()  # a dict of columns
    frame = Frame({"clock": T, "theta[deg]": Q[:, 0], "tau": Q[:, 1]})
    found = as_trajectories(frame, time="clock")
    assert (found.names, found.units) == (("theta",), ("rad",))
    assert found.u is not None
    assert as_trajectories([frame, frame], time="clock", inputs=()).lengths == (4, 4)


def test_the_name_of_a_series_holds_its_unit():  # fails if x[m] is a name of four letters, or degrees stay degrees
    found = as_trajectories(Series([1, 2, 3, 4], T, "x[m]"))
    assert (found.names, found.units, found.angles) == (("x",), ("m",), (False,))
    found = as_trajectories(Series([10, 20, 30, 40], T, "theta [deg]"))
    assert (found.names, found.units, found.angles, found.degrees) == (("theta",), ("rad",), (True,), ("theta",))
    assert found.q[:, 0].tolist() == pytest.approx(np.radians([10, 20, 30, 40]))
    frame = Series(Q, T, None)
    frame.columns = ["x[m]", "phi"]  # type: ignore[attr-defined]
    found = as_trajectories(frame, h=0.1)
    assert (found.names, found.units) == (("x", "phi"), ("m", "1"))


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        (Q, {}, "positions without times: give h"),
        (Q, {"h": [0.1, 0.2]}, "h is the time between two samples, one number; where steps differ, give time"),
        (Q, {"h": 0.1, "time": T}, "positions without times: give h, the time between two samples, or time"),
        ([[1, 2], [1, 2, "x"]], {"h": 0.1}, "not numbers|trajectory 0 has 2 samples"),
        ("nothing.csv", {}, "no such file"),
        ([None, None], {}, "None is no recording; give positions"),
        ([Q, None], {"h": 0.1}, "None is no recording"),
        (3, {"h": 0.1}, "3 is no recording"),
        ([], {}, r"\[\] is no recording"),
        (Q[:0], {"h": 0.1}, r"array\(\[\], .* is no recording"),
        (Q, {"h": 0.1, "group": "run"}, "group and drop are of tables"),
        (Trajectories.of(T, Q), {"h": 0.1}, "have their columns already"),
        (Trajectories.of(T, Q), {"time": T}, "have their columns already"),
        ([Q, Q], {"time": T}, "time and inputs of several arrays"),
        (Q, {"h": 0.1, "coordinates": ("x[", "y")}, "names no coordinate; write name or name"),
    ],
)
def test_mistakes(data, options, message):  # fails if a mistake is a traceback, or an option is ignored
    with pytest.raises(InputError, match=message):
        as_trajectories(data, **options)


def test_a_notebook_is_told_without_red_ground(capsys, monkeypatch):
    # fails if the table of columns goes to stderr in a notebook, where it looks like a failure
    monkeypatch.setitem(sys.modules, "ipykernel", sys)
    as_trajectories(Frame({"t": T, "load": Q[:, 0]}))
    out, err = capsys.readouterr()
    assert "coordinate" in out
    assert err == ""


@pytest.mark.parametrize("kind", ["frame", "dict", "path"])
def test_the_table_tells_of_the_angles_that_are_named(capsys, tmp_path, kind):
    # fails if the table is printed before angles are marked: it then shows another role and unit than the fit takes
    columns = {"t": T, "theta": Q[:, 0], "x": Q[:, 1]}
    path = tmp_path / "motion.csv"
    path.write_text("t,theta,x\n" + "".join(f"{t},{a},{b}\n" for t, (a, b) in zip(T, Q, strict=True)))
    as_trajectories({"frame": Frame(columns), "dict": columns, "path": path}[kind], angles="theta")
    lines = [line.split() for line in capsys.readouterr().err.splitlines()]
    assert lines[2:] == [["t", "time", "-", "(taken", "for", "s)"], ["theta", "angle", "rad"], ["x", "coordinate", "-"]]


@pytest.mark.parametrize("name", ["t", None])
@pytest.mark.parametrize("clock", ["floats", "dates"])
def test_the_index_of_a_frame_is_its_time(name, clock):  # fails if a DataFrame's index of times is dropped
    pandas = pytest.importorskip("pandas")
    dates = pandas.to_datetime("2024-05-01") + pandas.to_timedelta(T, unit="s")
    index = pandas.Index(T) if clock == "floats" else dates
    found = as_trajectories(pandas.DataFrame({"x": Q[:, 0]}, index=index.rename(name)))
    assert (found.names, found.t.tolist()) == (("x",), pytest.approx(T.tolist()))


def test_an_index_that_counts_is_no_coordinate(tmp_path):  # fails if the index of joined frames becomes a coordinate
    pandas, _ = pytest.importorskip("pandas"), pytest.importorskip("pyarrow")
    one = pandas.DataFrame({"t": T, "x": Q[:, 0], "run": "a"})
    both = pandas.concat([one, one.assign(run="b")])
    both.to_parquet(tmp_path / "both.parquet")
    for found in (as_trajectories(both, group="run"), as_trajectories(tmp_path / "both.parquet", group="run")):
        assert (found.names, found.lengths) == (("x",), (4, 4))


def test_sensors_of_none(tmp_path):  # fails if None, which options left out often are, is a traceback
    rows = "".join(f"{t},{x}\n" for t, (x, _) in zip(T, Q, strict=True))
    (tmp_path / "a.csv").write_text("t,x\n" + rows)
    arrays = as_trajectories(Q, h=0.1)
    for data in (tmp_path / "a.csv", {"t": T, "x": Q[:, 0]}, [arrays, arrays], arrays):
        found = as_trajectories(data, sensor_zeros=None, sensor_scales=None)
        assert found.q[: len(Q), 0].tolist() == Q[:, 0].tolist()
