"""Positions of bodies on circles become angles: one body, chains, centres that are found, given or known."""

import re
from typing import Any

import numpy as np
import pytest
import torch

from herglotz.data import Trajectories, as_trajectories, load, save
from herglotz.data.polar import circle
from herglotz.errors import InputError

T = np.arange(200) / 30
A, B = 1.1 * np.cos(3 * T) * np.exp(-0.02 * T), 0.9 * np.sin(2.3 * T)
CENTRE = np.array([0.3, 0.8])
NOISE = 0.001 * np.random.default_rng(0).standard_normal((2, len(T), 2))


def arm(angle, length: Any = 0.8):
    return length * np.stack([np.sin(angle), -np.cos(angle)], 1)


ONE = CENTRE + arm(A)
TWO = ONE + arm(B, 0.5)


def written(folder, header, *columns):
    table = np.column_stack([T[: len(columns[0])], *columns])
    np.savetxt(folder / "a.csv", table, delimiter=",", header=f"t[s],{header}", comments="")
    return folder / "a.csv"


def close(q, angle, error=1e-6):
    torch.testing.assert_close(q, torch.from_numpy(angle), atol=error, rtol=0)


def test_circles_of_least_squares():
    # fails if the centre is that of the points, the algebraic fit's (off by more on noisy short arcs), or of a line is
    # no number
    assert np.abs(circle(torch.from_numpy(ONE)).numpy() - CENTRE).max() < 1e-12
    short = torch.from_numpy(CENTRE + arm(0.5 * A) + 10 * NOISE[0])
    r = (short - circle(short)).norm(dim=1)
    for move in torch.tensor([[1, 0], [-1, 0], [0, 1], [0, -1]]) * 1e-3:
        assert (short - circle(short) - move).norm(dim=1).var() > r.var()
    assert bool(circle(torch.stack([torch.arange(5.0), torch.arange(5.0)], 1).double()).isfinite().all())


def test_one_body(tmp_path, capsys):
    # fails if x, y stay two freedoms, the angle has another zero or sense, or nothing is said of centre and radius
    path = written(tmp_path, "x[m],F[N],y[m]", ONE[:, 0] + NOISE[0, :, 0], A, ONE[:, 1] + NOISE[0, :, 1])
    data = load(path, polar="x,y")
    assert data.u is not None
    assert (data.names, data.units, data.angles, data.u.shape) == (("theta",), ("rad",), (True,), (200, 1))
    close(data.q[:, 0], A, 0.006)
    assert float((data.q[:, 0] - torch.from_numpy(A)).std()) < 0.0016  # 0.001 m at 0.8 m, and the centre's own error
    err = capsys.readouterr().err
    for line in ("x       of theta      m", "theta   angle         rad", "F       input         N"):
        assert f"  {line}\n" in err
    told = (
        r"theta is the angle of x, y about \((.*), (.*)\) m, at (.*) m to within (.*) m; 0 towards -y, growing towards"
    )
    found = re.search(told + r" \+x\n", err)
    assert found
    assert [float(x) for x in found.groups()] == pytest.approx([0.3, 0.8, 0.8, 0.001], abs=2e-4)
    assert "warning" not in err


@pytest.mark.parametrize(
    ("columns", "told"),
    [
        ([ONE[:, 0], ONE[:, 1]], "x,y,0.3,0.8"),
        ([ONE[:, 0], -ONE[:, 1]], "x,-y,0.3,-0.8"),
        ([ONE[:, 0], -ONE[:, 1]], "x,-y"),
        ([2 - ONE[:, 0], ONE[:, 1]], "-x[m], y[m]"),
        ([ONE[:, 0] + T, ONE[:, 1], CENTRE[0] + T, CENTRE[1] + 0 * T], "x,y,cart,h"),
    ],
)
def test_axes_and_centres_as_told(tmp_path, columns, told):
    # fails if a given centre is fitted, an axis keeps its sense, or a moving centre is taken for a fixed one
    header = ",".join(["x[m]", "y[m]", "cart[m]", "h[m]"][: len(columns)])
    data = load(written(tmp_path, header, *columns), polar=told)
    assert data.names == ("theta",)
    close(data.q[:, 0], A)


def test_an_axis_that_grows_downwards_is_said(tmp_path, capsys):  # fails if a hanging body rests at π unsaid
    load(written(tmp_path, "x[m],y[m]", ONE[:, 0], -ONE[:, 1]), polar="x,y")
    assert "growing towards +x; if y grows the other way: --polar x,-y" in capsys.readouterr().err


def test_a_chain_and_two_bodies_apart(tmp_path, capsys):
    # fails if the second arm is measured from the pivot, a body beside is hung on the first, or the table says that a
    # position which is also a centre belongs to the second angle
    names = "x1[m],y1[m],x2[m],y2[m]"
    chain = load(written(tmp_path, names, ONE + NOISE[0], TWO + NOISE[1]), polar=["x1,y1", "x2,y2"])
    assert chain.names == ("theta1", "theta2")
    assert "theta2 is the angle of x2, y2 about x1, y1, at " in capsys.readouterr().err
    close(chain.q[:, 1], B, 0.012)
    given = load(tmp_path / "a.csv", polar=["x1,y1", "x2,y2,x1,y1"], show=False)
    assert [role for _, role, _ in given.columns[1:5]] == ["of theta1"] * 2 + ["of theta2"] * 2
    other = np.array([3.0, 0.5]) + arm(B, 0.5)
    apart = load(written(tmp_path, names, ONE + NOISE[0], other + NOISE[1]), polar=["x1,y1", "x2,y2"])
    assert "theta2 is the angle of x2, y2 about (" in capsys.readouterr().err
    close(apart.q[:, 1], B, 0.012)


def test_a_distance_that_changes(tmp_path, capsys):
    # fails if a spring or a winch loses its length unsaid, or the centre of its circle, which it has not, is looked for
    r = 0.8 + 0.05 * np.sin(4 * T)
    path = written(tmp_path, "x[m],y[m]", CENTRE + arm(A, r[:, None]) + 0.5 * NOISE[0])
    said = "its noise is 0.0005 m; if a length changes: --polar x,y,"
    for polar, remedy in (
        ("x,y", "X,Y,r, with the centre in numbers or columns, keeps"),
        ("x,y,0.3,0.8", "0.3,0.8,r keeps"),
    ):
        load(path, polar=polar)
        assert f"{said}{remedy} it as a coordinate r" in capsys.readouterr().err
    data = load(path, polar="x,y,0.3,0.8,r")
    assert "warning" not in capsys.readouterr().err
    assert (data.names, data.units, data.angles) == (("theta", "r"), ("rad", "m"), (True, False))
    close(data.q, np.stack([A, r], 1), 0.003)
    save(tmp_path / "run.npz", data)
    again = load(path, like=load(tmp_path / "run.npz"))
    assert torch.equal(again.q, data.q)


def test_another_recording_is_made_the_same(tmp_path):
    # fails if predict needs --polar again, a small arc gets a centre of its own, or a camera that moved keeps the old
    told = load(written(tmp_path, "x[m],y[m]", ONE + NOISE[0]), polar="x,y", show=False)
    save(tmp_path / "run.npz", told)
    told = load(tmp_path / "run.npz")
    small = written(tmp_path, "x[m],y[m]", CENTRE + arm(0.02 * A) + NOISE[1])
    kept, own = load(small, like=told), load(small, polar="x,y")
    assert load(small, like=told, polar=()).names == ("x", "y")
    assert kept.columns[-1] == told.columns[-1]
    close(kept.q[:, 0], 0.02 * A, 0.007)
    assert float((own.q[:, 0] - torch.from_numpy(0.02 * A)).abs().max()) > 0.02
    moved = load(written(tmp_path, "x[m],y[m]", ONE + NOISE[1] + [0.2, 0.1]), like=told)
    close(moved.q[:, 0], A, 0.006)
    angle = load(written(tmp_path, "theta[rad]", A), like=told)
    close(angle.q[:, 0], A)


def test_tables_and_arrays():  # fails if only files are made so
    table = {"t": T, "x": ONE[:, 0], "y": ONE[:, 1], "z": T}
    assert as_trajectories(table, polar="x,y").names == ("theta", "z")
    arrays = as_trajectories(ONE, h=1 / 30, coordinates=["x", "y"], polar="x,y")
    close(arrays.q[:, 0], A)
    given = as_trajectories(Trajectories.of(T, ONE, names=("x", "y")), polar="x,y")
    assert given.angles == (True,)
    assert as_trajectories(table, like=arrays).names == ("theta", "z")


def test_columns_that_are_named_are_positions(tmp_path):
    # fails if positions by the user's word stay inputs, or the angle takes the name of another coordinate
    path = written(tmp_path, "u_x[m],u_y[m],theta[rad]", ONE[:, 0], ONE[:, 1], B)
    data = load(path, polar="u_x,u_y")
    assert (data.names, data.u) == (("theta_u_x", "theta"), None)


@pytest.mark.parametrize(
    ("polar", "message"),
    [
        ("x", "polar: 'x' is no pair of columns; write x,y or"),
        ("x,x", "'x,x' is no pair of columns"),
        ("x,y,0.3", "'x,y,0.3' is no pair of columns"),
        ("x,y,r", "'x,y,r' is no pair of columns; .*; x,y,X,Y,r keeps the distance"),
        ("x,y,0.3,z", "give both numbers of the centre, or both columns"),
        ("x,w", "there is no column 'w'; the columns are t, x, y, z, a, p_x"),
        ("x,a", "x, a are not in one unit, but in"),
        (["x,y", "y,z"], "polar has a column twice, x, y, y, z"),
        ("x,y,0.3,1.6", r"x, y is at its centre at t = 0, and has no angle there"),
    ],
)
def test_mistakes_say_what_to_do(tmp_path, polar, message):  # fails if a mistake becomes a wrong angle
    still = np.r_[[[0.3, 1.6]], ONE[1:]]
    path = written(tmp_path, "x[m],y[m],z[m],a[rad],p_x", still[:, 0], still[:, 1], ONE[:, 0], A, B)
    with pytest.raises(InputError, match=message):
        load(path, polar=polar, drop="p_x")
    with pytest.raises(InputError, match="polar names 'x', but the coordinates are z"):
        load(path, polar="x,y", coordinates="z", drop="p_x")
    with pytest.raises(InputError, match="momenta of positions are no momenta of angles"):
        load(written(tmp_path, "x[m],y[m],p_x,p_y", ONE, ONE), polar="x,y")


def test_a_body_on_a_circle_is_said(tmp_path, capsys):
    # fails if two freedoms are fitted to one without a word, or the chain's second body is missed
    names = "ax[m],ay[m],bx[m],by[m]"
    load(written(tmp_path, names, ONE + NOISE[0], TWO + NOISE[1]))
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning")]
    assert len(lines) == 2
    assert lines[0].startswith("warning: a.csv: ax, ay stay on a circle about (")
    assert lines[0].endswith("one body on an arm? --polar ax,ay (polar= in Python) makes one angle of it")
    assert "bx, by stay on a circle about ax, ay, at " in lines[1]
    assert lines[1].endswith(
        "bodies on arms? --polar ax,ay --polar bx,by,ax,ay (polar= in Python) makes one angle of each"
    )
    # The first is told.
    load(tmp_path / "a.csv", polar="ax,ay")
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("warning"))
    assert line.endswith("--polar bx,by,ax,ay (polar= in Python) beside --polar ax,ay makes one angle of it")
    load(tmp_path / "a.csv", polar=["ax,ay", "bx,by"])
    assert "stay on a circle" not in capsys.readouterr().err
    as_trajectories({"t": T, "x": ONE[:, 0], "y": ONE[:, 1]})
    assert "warning: dict: x, y stay on a circle" in capsys.readouterr().err


def test_a_centre_that_moves_is_part_of_the_remedy(tmp_path, capsys):
    # fails if the flag finds a fixed centre where the sentence has another one, or its axis has no sign
    pivot = np.column_stack([np.cos(1.7 * T), 0.1 * np.sin(0.3 * T)])
    path = written(tmp_path, "px[m],py[m],bx[m],by[m]", pivot + NOISE[0], pivot + arm(A) * [1, -1])
    load(path)
    said = "bx, by stay on a circle about px, py, at 0.8 m; one body on an arm? --polar bx,by,px,py (polar= in Python)"
    assert said in capsys.readouterr().err
    assert load(path, polar="bx,by,px,py").names == ("theta",)
    assert "if by grows the other way: --polar bx,-by,px,py" in capsys.readouterr().err
    for told in ("bx,-by,px,py", "bx,-by,px,-py"):
        close(load(path, polar=told, show=False).q[:, 0], A, 0.006)
    with pytest.raises(InputError, match="-py of the centre has a sign that its axis has not"):
        load(path, polar="bx,by,px,-py")


MOTIONS = {
    "on a line": np.stack([A, 0.5 * A], 1) + NOISE[0],
    "two modes": np.stack([np.cos(3 * T), np.sin(5 * T)], 1),
    "an ellipse": np.stack([np.cos(3 * T), 0.7 * np.sin(3 * T)], 1),
    "noise": 1000 * NOISE[0],
}


@pytest.mark.parametrize("kind", MOTIONS)
def test_other_motions_are_no_circles(tmp_path, capsys, kind):  # fails if every plane motion is called a circle
    load(written(tmp_path, "x[m],y[m]", MOTIONS[kind]))
    assert "circle" not in capsys.readouterr().err


def test_nothing_is_said_where_the_user_has_spoken(tmp_path, capsys):  # fails if a choice is questioned
    path = written(tmp_path, "x[m],y[m]", ONE)
    load(path, coordinates=["x", "y"])
    load(path, polar=())
    load(path, polar="none")
    load(path, like=load(path, polar=()))
    load(written(tmp_path, "x[m],z[m]", ONE))
    assert "circle" not in capsys.readouterr().err
