"""Tables that robots write: joint states of ROS, whose stamps are whole nanoseconds, with numbers in brackets."""

import numpy as np
import pytest

from herglotz.data import as_trajectories, load, read_csv, save
from herglotz.data.column_roles import heads_of
from herglotz.data.csv_columns import assign
from herglotz.errors import InputError

START = 1_690_000_000_000_003_141
STEPS = [0, 9_994_118, 19_952_750, 30_001_282]
JOINT = {"position[0]": [0.1, 0.2, 0.4, 0.5], "velocity[0]": [1.0, 2.0, 2.0, 1.0], "effort[0]": [0.5, 0.5, -0.5, -0.5]}


def written(folder, columns, name="a.csv"):
    rows = zip(*columns.values(), strict=True)
    (folder / name).write_text("\n".join([",".join(columns), *(",".join(map(str, row)) for row in rows)]) + "\n")
    return folder / name


def stamped(name="header.stamp", start=START):
    return {name: [start + k for k in STEPS], "name[0]": ["shoulder"] * 4, **JOINT}


def test_joint_states_of_ros(tmp_path, capsys):
    # fails if the stamp is no time, loses digits, or counts as seconds, or if [0] of a name is a unit
    path = written(tmp_path, stamped())
    folder = tmp_path / "two"
    folder.mkdir()
    for k in range(2):
        written(folder, stamped(start=START + k * 10**12), f"{k}.csv")
    frame = {name: np.array(x) for name, x in stamped().items()}
    for data in (load(path), load(folder), as_trajectories(frame)):
        assert data.t[:4].tolist() == [k / 1e9 for k in STEPS]
        assert (data.names, data.units, data.time_unit) == (("position[0]",), ("1",), "s")
        assert data.input_labels == (("effort[0]", ""),)
        roles = ["time", "left aside", "coordinate", "left aside", "input"]
        assert [role for _, role, _ in data.columns] == roles
        assert "header.stamp  time          taken for ns since 1970, converted to s" in data.table()
    assert "warning" not in capsys.readouterr().err
    assert read_csv(path).time_unit == "ns"


@pytest.mark.parametrize(
    "name",
    ["header.stamp", "stamp", "%time", "__time", "field.header.stamp", "rosbagTimestamp", "timestamp_ns",
     "/joint_states/header/stamp"],
)  # fmt: skip
def test_names_of_stamps(tmp_path, name):  # fails if a usual stamp of ROS is no time
    assert load(written(tmp_path, stamped(name))).t.tolist() == [k / 1e9 for k in STEPS]


def test_a_topic_that_ros_prints():  # fails if the time of receipt comes before the stamp, or a counter is a motion
    header = "%time,field.header.seq,field.header.stamp,field.position0,field.velocity0,field.effort0"
    roles = ["left aside", "left aside", "time", "coordinate", "left aside", "input"]
    assert [role for _, role, _ in assign(header.split(","), "header").roles()] == roles


@pytest.mark.parametrize(("count", "unit"), [(10**9, "ns"), (10**6, "us"), (10**3, "ms")])
def test_stamps_since_1970_show_their_unit(tmp_path, count, unit):
    # fails if a stamp of 1.7e18, 1.7e15 or 1.7e12 is refused or has another unit, or a unit is overruled
    stamps = [1_700_000_000 * count + k * count for k in range(4)]
    data = load(written(tmp_path, {"stamp": stamps, "x[m]": [1, 2, 3, 5]}))
    assert (data.t - data.t[0]).tolist() == [0.0, 1.0, 2.0, 3.0]
    assert data.columns[0] == ("stamp", "time", f"taken for {unit} since 1970")
    told = load(written(tmp_path, {"stamp[us]": stamps, "x[m]": [1, 2, 3, 5]}))
    assert (told.t - told.t[0]).tolist() == pytest.approx([k * count / 1e6 for k in range(4)], abs=1e-6)


@pytest.mark.parametrize("start", [86_000_000_000_000, 133_500_000_000_000_001])
def test_other_large_counts_are_refused(tmp_path, start):
    # fails if nanoseconds of a day, or 100 ns since 1601, which are above 2^53, are taken for a time in s
    with pytest.raises(InputError, match=r"stamp of .* is no time in s; write its unit, stamp\[ms\], .* stamp\[ns\]"):
        load(written(tmp_path, stamped("stamp", start)))


def test_a_bad_stamp_among_large_stamps(tmp_path):  # fails if a text has the message of a stamp above 2^53
    columns = stamped()
    columns["header.stamp"][2] = "late"
    with pytest.raises(InputError, match=r"row 4, column 'header\.stamp': 'late' is not a number"):
        load(written(tmp_path, columns))


@pytest.mark.parametrize(
    ("cells", "heads"),
    [
        ("position[0],position[1]", [("position[0]", ""), ("position[1]", "")]),
        ("position[0],effort[1]", [("position[0]", ""), ("effort[1]", "")]),
        ("x[1],y[1]", [("x", "1"), ("y", "1")]),
        ("x[],y ()", [("x", ""), ("y", "")]),
        ("position[0][rad],position[1][rad]", [("position[0]", "rad"), ("position[1]", "rad")]),
        ("position[0][1],p_position[0]", [("position[0]", "1"), ("p_position[0]", "")]),
        ("poses[0].position.x,data[0][1],data[0][0]", [("poses[0].position.x", ""), ("data[0][1]", ""),
                                                      ("data[0][0]", "")]),
    ],
)  # fmt: skip
def test_a_number_in_brackets_belongs_to_the_name(cells, heads):
    # fails if an index is a unit, the unit 1 is an index, a name with an index has no unit, or brackets are empty
    assert heads_of(cells.split(",")) == heads


def test_roles_of_names_with_numbers_in_brackets():  # fails if q[0] has another role than q0
    header = "t,q[0],q[1],dq[0],qd[1],u[0],u[1]"
    found = assign(header.split(","), "header")
    assert [role for _, role, _ in found.roles()] == ["time", *["coordinate"] * 2, *["left aside"] * 2, *["input"] * 2]
    assert not found.notes


def test_names_with_numbers_survive_a_file(tmp_path):  # fails if a set with such names cannot be saved as csv
    path = written(tmp_path, {"t": [0, 1, 2, 3], "q[0][rad]": [1, 2, 4, 8], "q[1]": [0, 1, 1, 2]})
    data = load(path, unwrap=False)
    save(tmp_path / "b.csv", data)
    again = load(tmp_path / "b.csv", unwrap=False)
    assert (again.names, again.units, again.q.tolist()) == (data.names, data.units, data.q.tolist())
