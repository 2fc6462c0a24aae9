"""A column that moves in jumps alone is asked for: it may be a set point, and no mechanism moves so."""

import numpy as np
import pytest

from herglotz.cli import main
from herglotz.data import Trajectories, as_trajectories, load
from herglotz.data.readers import jumping
from herglotz.errors import InputError

T = np.arange(80) * 0.05


def held(levels, each=10):
    return np.repeat(np.array(levels, dtype=float), each)


def written(folder, **columns):
    names, table = ["t[s]", *columns], np.column_stack([T, *columns.values()])
    np.savetxt(folder / "a.csv", table, delimiter=",", header=",".join(names), comments="", fmt="%.6g")
    return folder / "a.csv"


def test_levels_that_are_leapt_to_are_asked_for(tmp_path, capsys):
    # fails if a set point is fitted as a coordinate, or refused as one that never moves; or the remedy forgets an input
    levels = held([0, 1, -0.5, 0.8, 0.8, 0, 0.3, 0.3])
    path = written(tmp_path, **{"a[m]": levels, "b[m]": np.sin(T), "F[N]": np.cos(T)})
    said = r"a moves in jumps alone \(0, 1, -0.5, 0.8, …\); an input\? --inputs F,a \(inputs= in Python\); a coordinate"
    with pytest.raises(InputError, match=said + " all the same: --coordinates a,b"):
        load(path)
    assert main(["fit", str(path), "--out", str(tmp_path / "run")]) == 2
    assert "moves in jumps alone" in capsys.readouterr().err
    with pytest.raises(InputError, match="dict: a moves in jumps alone"):
        as_trajectories({"t": T, "a": levels, "b": np.sin(T)})
    told = load(path, inputs=["F", "a"])
    assert told.input_labels == (("a", "m"), ("F", "N"))
    assert load(path, coordinates=["a", "b"]).names == ("a", "b")
    assert load(path, like=told).names == ("b",)
    assert load(path, like=load(path, coordinates=["a", "b"])).names == ("a", "b")


def test_the_remedy_names_the_coordinates_too(tmp_path):
    # fails if the input that jumps is taken away, and what has neither a unit nor a usual name becomes a coordinate
    columns = {"delta[deg]": np.sin(T), "Pm": held([0.3, 0.7, 0.4, 1.1], 20), "Pe": np.cos(T), "Vt": np.cos(2 * T)}
    some = ", with those of Pe, Vt that are positions"
    said = r"--inputs Pm \(inputs= in Python\) and --coordinates delta"
    same = f"{some}; a coordinate all the same: --coordinates delta,Pm{some}$"
    path = written(tmp_path, **columns)
    with pytest.raises(InputError, match=said + same):
        load(path)
    assert load(path, inputs="Pm", coordinates="delta").names == ("delta",)


def test_degrees_are_named_as_they_stand(tmp_path):  # fails if levels of a table in degrees are shown in radians
    with pytest.raises(InputError, match=r"a moves in jumps alone \(0, 90, -45, 30\)"):
        load(written(tmp_path, **{"a[deg]": held([0, 90, -45, 30], 20), "b[deg]": 9 * np.sin(T)}))


MOTIONS = {
    "slow motion of a coarse sensor": np.round(6 * np.sin(0.4 * T)),
    "at rest": np.zeros(80),
    "a ramp from one level to another": np.clip(T - 1, 0, 1),
    "released at last": np.r_[np.zeros(60), np.sin(T[:20])],
    "a stair": held(range(8)),
}


@pytest.mark.parametrize("kind", MOTIONS)
def test_what_a_mechanism_can_do_is_no_jump(kind):  # fails if a coordinate that stands still at times is refused
    assert jumping(Trajectories.of(T, np.c_[MOTIONS[kind], np.sin(T)])) == []


@pytest.mark.parametrize(
    "levels", [held([0, 1] * 4), held([0, 1], 40), np.r_[0.0, held([2], 39), held([1], 40)], held([5, -5, 5, -4] * 2)]
)
def test_steps_of_a_set_point(levels):
    # fails if a single step, two levels, or a change of the first sample hides a set point
    assert jumping(Trajectories.of(T, np.c_[levels, np.sin(T)])) == ["q1"]


def test_gaps_and_ends_of_recordings_are_no_jumps():
    # fails if motion that went on in a gap, or the start of the next recording, counts as a jump
    t = np.r_[T[:40], T[40:] + 1]
    assert jumping(Trajectories.of(t, np.r_[np.zeros(40), np.ones(40)])) == []
    assert jumping(Trajectories.of(t, np.r_[np.zeros(40), 5, -np.ones(39)])) == []
    assert jumping(Trajectories.of(np.r_[T[:40], T[:40]], held([0, 1], 40), (40, 40))) == []
    assert jumping(Trajectories.of(np.r_[T[:40], T[:40]], held([0, 3, 3, 1], 20), (40, 40))) == ["q"]
    # The last step of a recording is a jump, and so is the first of the next.
    ends = np.r_[held([0, 2], 15), held([2], 9), 1.0, np.r_[0.0, held([2], 39)]]
    assert jumping(Trajectories.of(np.r_[T[:40], T[:40]], ends, (40, 40))) == ["q"]
