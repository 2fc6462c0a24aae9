"""`load` and `save`: the right format, angles continuous, unknown formats explained."""

import numpy as np
import pytest
from test_csv_format import rich

from herglotz.data import Trajectories, load, save
from herglotz.data.units import in_radians_and_seconds
from herglotz.errors import InputError

WRAPPED = "t,q[rad]\n0,3.0\n1,-3.0\n2,-2.5\n"


@pytest.mark.parametrize("name", ["a.csv", "a.npz", "A.CSV", "b.NPZ"])
def test_save_then_load(tmp_path, name):  # fails if an extension goes to the wrong format
    save(tmp_path / name, rich())
    assert load(str(tmp_path / name)).digest() == in_radians_and_seconds(rich()).digest()


def test_angles_are_unwrapped_unless_told(tmp_path):  # fails if unwrapping or either option is dropped
    (tmp_path / "a.csv").write_text(WRAPPED)
    np.testing.assert_allclose(load(tmp_path / "a.csv").q[:, 0], [3, 2 * np.pi - 3, 2 * np.pi - 2.5], atol=1e-15)
    assert load(tmp_path / "a.csv", unwrap=False).q[:, 0].tolist() == [3, -3, -2.5]
    assert load(tmp_path / "a.csv", angles=()).q[:, 0].tolist() == [3, -3, -2.5]
    (tmp_path / "b.csv").write_text(WRAPPED.replace("[rad]", ""))
    assert load(tmp_path / "b.csv").q[1, 0] == -3
    assert load(tmp_path / "b.csv", angles="q").q[1, 0] == pytest.approx(2 * np.pi - 3)
    np.savez(tmp_path / "c.npz", t=[0, 1, 2], q=[3, -3, -2.5])
    assert load(tmp_path / "c.npz", angles=["q"]).q[1, 0] == pytest.approx(2 * np.pi - 3)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.xyz", "x", r"a.xyz: cannot read .xyz; known formats: .*\.npz.*\.csv"),
        ("a", "x", r"a: cannot read a file without extension"),
        ("a.txt", "t,q\n", r"a.txt: there is a header but no samples"),
        ("a.npz", "t,q\n", r"a.npz: is not a .npz archive"),
    ],
)
def test_unknown_formats(tmp_path, name, text, message):  # fails if the list of what is read is not shown
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        load(tmp_path / name)


def test_absent(tmp_path):  # fails if an absent .dat is reported as an unknown format
    with pytest.raises(InputError, match="there is no such file"):
        load(tmp_path / "a.dat")


def test_save_elsewhere(tmp_path):  # fails if a format is guessed
    data = Trajectories.of([0, 1, 2], [0, 1, 2])
    with pytest.raises(InputError, match=r"a.mat: cannot write .mat; written are .csv and .npz"):
        save(tmp_path / "a.mat", data)
    with pytest.raises(InputError, match=r"cannot write a file without extension"):
        save(tmp_path / "a", data)
