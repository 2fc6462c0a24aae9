"""Parquet, HDF5 and MATLAB files: the trajectories of the csv; without their packages, a line that names the extra.

The packages are extras: where one is missing, a stand-in with the same calls takes its place.
"""

import importlib.util
import sys
import types

import numpy as np
import pytest

from herglotz.data import load
from herglotz.errors import InputError

T = np.arange(40) * 0.1
COLUMNS = {"t[s]": T, "theta[rad]": np.cos(T), "x[m]": np.sin(T), "u": T**2}


def have(name):
    return importlib.util.find_spec(name) is not None


@pytest.fixture
def as_csv(tmp_path):
    rows = np.stack(list(COLUMNS.values()), 1)
    np.savetxt(tmp_path / "a.csv", rows, "%.17g", ",", header=",".join(COLUMNS), comments="")
    return load(tmp_path / "a.csv", show=False)


def same(found, expected):
    """Everything but the file's name."""
    assert (found.names, found.units, found.angles) == (expected.names, expected.units, expected.angles)
    for name in ("t", "q", "u"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


class Parquet(types.ModuleType):
    """The two calls of pyarrow.parquet that the reader makes."""

    def read_table(self, path):  # noqa: ARG002
        column = lambda name: types.SimpleNamespace(to_numpy=lambda: COLUMNS[name])  # noqa: E731
        return types.SimpleNamespace(column_names=list(COLUMNS), column=column)


def test_parquet(tmp_path, monkeypatch, as_csv):  # fails if a column loses its name, unit or role
    path = tmp_path / "a.parquet"
    if have("pyarrow"):
        import pyarrow  # pyright: ignore[reportMissingImports]
        from pyarrow import parquet  # pyright: ignore[reportMissingImports]

        parquet.write_table(pyarrow.table(COLUMNS), path)
    else:
        path.write_bytes(b"PAR1")
        monkeypatch.setitem(sys.modules, "pyarrow", types.ModuleType("pyarrow"))
        monkeypatch.setitem(sys.modules, "pyarrow.parquet", Parquet("pyarrow.parquet"))
    same(load(path, show=False), as_csv)
    assert load(path, show=False, coordinates="x", drop="theta").names == ("x",)


def test_matlab(tmp_path, monkeypatch, as_csv):  # fails if a matrix is not cut into columns, or text is read as one
    path, q = tmp_path / "a.mat", np.stack([np.cos(T), np.sin(T)], 1)
    stored = {"__header__": b"", "t": T[:, None], "q": q, "u": T[None] ** 2, "note": np.array(["by hand"])}
    if have("scipy"):
        from scipy.io import savemat  # pyright: ignore[reportMissingImports]

        savemat(path, {name: x for name, x in stored.items() if not name.startswith("_")})
    else:
        path.write_bytes(b"MATLAB 5.0 MAT-file")
        stand_in = types.ModuleType("scipy.io")
        stand_in.loadmat = lambda *_, **__: stored  # pyright: ignore[reportAttributeAccessIssue]
        monkeypatch.setitem(sys.modules, "scipy", types.ModuleType("scipy"))
        monkeypatch.setitem(sys.modules, "scipy.io", stand_in)
    found = load(path, show=False)
    assert found.names == ("q1", "q2")
    np.testing.assert_array_equal(found.q, as_csv.q)
    np.testing.assert_array_equal(found.u, as_csv.u)


RUN = {"t": T, "x": np.cos(T)}


@pytest.mark.parametrize(
    ("stored", "found"),
    [
        ({"runs": [RUN, RUN], "fs": 10.0, "name": "two"}, (40, 40)),
        ({"runs": np.array([RUN, RUN]), "fs": 10.0}, (40, 40)),
        ({"exp": {"runs": [RUN, RUN], "fs": 10.0}}, (40, 40)),
        ({"data": RUN, "cells": [T, T[1:]]}, (40,)),
        ({"empty": np.zeros((0, 0))}, r"a\.mat: holds no vectors of numbers; save t and q"),
        ({"data": {"name": "text"}}, r"a\.mat: holds no vectors of numbers; save t and q"),
        ({"a": RUN, "b": RUN}, "two arrays are called"),
        ({"runs": [RUN, RUN], "t": T}, r"a\.mat: runs is a struct array beside other variables; save it in a file of"),
    ],
)
def test_variables_of_matlab(tmp_path, monkeypatch, stored, found):
    # fails if numbers beside a struct array hide it, or a file without vectors is refused without its name
    (tmp_path / "a.mat").write_bytes(b"MATLAB 5.0 MAT-file")
    stand_in = types.ModuleType("scipy.io")
    stand_in.loadmat = lambda *_, **__: {"__version__": "1.0"} | stored  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "scipy", types.ModuleType("scipy"))
    monkeypatch.setitem(sys.modules, "scipy.io", stand_in)
    if isinstance(found, tuple):
        assert load(tmp_path / "a.mat").lengths == found
        return
    with pytest.raises(InputError, match=found):
        load(tmp_path / "a.mat")


class Dataset(np.ndarray):
    """What the reader asks a dataset of h5py for."""

    attrs: dict


class File(dict):
    """What the reader asks a file of h5py for: a group is in the way of its datasets."""

    def __init__(self, *_):
        super().__init__({"run": None})
        for name, x in {**COLUMNS, "note": np.array(["by hand"]), "date": np.array(2026.0)}.items():
            own, _, unit = name.partition("[")
            self[f"run/{own}"] = x.view(Dataset)
            self[f"run/{own}"].attrs = {"units": unit.rstrip("]").encode()} if unit else {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def visititems(self, take):
        for name, item in self.items():
            take(name, item)


def test_what_is_no_column_of_hdf5(tmp_path, monkeypatch, as_csv):
    # fails if a group, a text or a single number beside the datasets is taken for a column
    stand_in = types.ModuleType("h5py")
    stand_in.Dataset, stand_in.File = Dataset, File  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setitem(sys.modules, "h5py", stand_in)
    (tmp_path / "a.h5").write_bytes(b"HDF")
    same(load(tmp_path / "a.h5", show=False), as_csv)


@pytest.mark.skipif(not have("h5py"), reason="h5py is an extra")
@pytest.mark.parametrize("suffix", ["h5", "hdf5", "mat"])
def test_hdf5(tmp_path, as_csv, suffix):  # fails if units are lost, a group is not opened, or 7.3's transpose stays
    import h5py  # pyright: ignore[reportMissingImports]

    path = tmp_path / f"a.{suffix}"
    with h5py.File(path, "w", userblock_size=512 if suffix == "mat" else 0) as file:
        for name, x in COLUMNS.items():
            own, _, unit = name.partition("[")
            file[f"run/{own}"] = x[None] if suffix == "mat" else x
            file[f"run/{own}"].attrs["unit"] = unit.rstrip("]")
    same(load(path, show=False), as_csv)


@pytest.mark.parametrize(("suffix", "module"), [("parquet", "pyarrow"), ("h5", "h5py"), ("mat", "scipy")])
def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch, suffix, module):
    # fails if a newcomer sees a ModuleNotFoundError
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"nothing")
    for name in (module, "pyarrow.parquet", "scipy.io"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=rf"{path.name}: reading it needs {module}; .*herglotz\[tables\]"):
        load(path)


@pytest.mark.parametrize(("suffix", "module"), [("parquet", "pyarrow"), ("h5", "h5py"), ("mat", "scipy")])
def test_a_damaged_file_is_refused(tmp_path, suffix, module):  # fails if the package's own exception comes through
    if not have(module):
        pytest.skip(f"{module} is an extra")
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"nothing at all" * 20)
    with pytest.raises(InputError, match="cannot be read"):
        load(path)
