"""Tables that other packages read: Parquet (pyarrow), HDF5 (h5py) and MATLAB (scipy; h5py for its version 7.3)."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from herglotz.data.csv_columns import Wanted
from herglotz.data.files import PathLike
from herglotz.data.sheet import from_frame
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError, refuse

INSTALL = "pip install 'herglotz[tables]'"
# A column that pandas adds: an index without a name.
COUNTER = re.compile(r"__index_level_\d+__")
# The first bytes of an HDF5 file. MATLAB's version 7.3 writes them below a text of 512 bytes.
HDF5 = b"\x89HDF\r\n\x1a\n"


class Table(dict[str, np.ndarray]):
    """Named columns of one length, as `herglotz.data.table.from_frame` takes them; a matrix gives a column a column."""

    def __init__(self, path: Path, arrays: dict[str, np.ndarray]):
        super().__init__()
        for name, array in arrays.items():
            matrix = array.reshape(-1, 1) if 1 in array.shape or array.ndim == 1 else array
            if matrix.ndim != 2:
                raise InputError(f"{path}: {name} has {array.ndim} dimensions; save vectors, or matrices (N, n)")
            # q[rad] of shape (N, 2) becomes q1[rad] and q2[rad].
            head, bracket, unit = name.partition("[")
            for i, column in enumerate(matrix.T, 1):
                self[name if matrix.shape[1] == 1 else f"{head}{i}{bracket}{unit}"] = column
        self.columns = list(self)
        lengths = {name: len(column) for name, column in self.items()}
        if len(set(lengths.values())) > 1:
            each = ", ".join(f"{name} {n}" for name, n in lengths.items())
            raise InputError(f"{path}: columns of different lengths ({each}); save one sample a row in all of them")


def read_packed(path: PathLike, wanted: Wanted) -> Trajectories:
    """Read a table of a suffix of `ARRAYS` like a csv file with the same header.

    Raise InputError if the package for the format is missing, the file is damaged, columns differ in length, or as
    `read_csv`.
    """
    recordings = ARRAYS[Path(path).suffix.lower()](path)
    return Trajectories.cat(from_frame(Table(Path(path), one), wanted, Path(path)) for one in recordings)


def _parquet(path: PathLike) -> list[dict[str, np.ndarray]]:
    """The columns of a Parquet file, without the index that pandas adds."""
    parquet = _package("pyarrow.parquet", path)
    table = _opened(path, lambda: parquet.read_table(str(path)))
    names = [name for name in table.column_names if not COUNTER.fullmatch(name)]
    return [{name: table.column(name).to_numpy() for name in names}]


def _matlab(path: PathLike) -> list[dict[str, np.ndarray]]:
    """The arrays of a MATLAB file, vectors t, q, u, ... or matrices (N, n), in structs as well.

    Every element of a struct array is a recording. Text and single numbers are left aside.
    """
    with Path(path).open("rb") as file:
        # Version 7.3 stores matrices transposed.
        if HDF5 in file.read(520):
            return [{name: array.T for name, array in one.items()} for one in _datasets(path)]
    scipy_io = _package("scipy.io", path)
    stored = _opened(path, lambda: scipy_io.loadmat(str(path), simplify_cells=True))
    recordings = [_vectors(path, one) for one in _recordings(stored)]
    what = "holds no vectors of numbers; save t and q, or a struct of them (a table: writetable to csv)"
    refuse({f"{path}: {what}": not all(recordings)})
    return recordings


def _recordings(stored: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    """The elements of the only struct array in a file or in its only struct; without a struct array the file itself."""
    inside = [
        x for name, x in stored.items()
        if not name.startswith("__") and (isinstance(x, Mapping) or _is_structs(x) or _is_array(x))
    ]  # fmt: skip
    if len(inside) != 1:
        return [stored]
    if isinstance(inside[0], Mapping):
        return _recordings(inside[0])
    return list(inside[0]) if _is_structs(inside[0]) else [stored]


def _is_array(x: Any) -> bool:
    """Whether a variable is an array of several numbers."""
    return isinstance(x, np.ndarray) and x.size > 1 and x.dtype.kind in "fiub"


def _is_structs(x: Any) -> bool:
    """Whether a variable is a struct array."""
    several = isinstance(x, list) or (isinstance(x, np.ndarray) and x.ndim == 1)
    return several and len(x) > 0 and all(isinstance(one, Mapping) for one in x)


def _vectors(path: PathLike, stored: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Arrays of numbers, by the last part of the name for arrays inside structs."""
    found: dict[str, np.ndarray] = {}
    for name, x in stored.items():
        inside = _vectors(path, x) if isinstance(x, Mapping) else {name: x}
        beside = f"{path}: {name} is a struct array beside other variables; save it in a file of its own"
        refuse({beside: _is_structs(x)})
        twice = found.keys() & inside.keys()
        refuse({f"{path}: two arrays are called {', '.join(twice)}; save each recording in a file of its own": twice})
        found |= {key: x for key, x in inside.items() if _is_array(x)}
    return found


def _datasets(path: PathLike) -> list[dict[str, np.ndarray]]:
    """Every dataset of numbers in an HDF5 file and its groups, by the last part of the name, with the unit."""
    h5py = _package("h5py", path)
    found: dict[str, np.ndarray] = {}

    def take(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "fiub" or not item.shape:
            return
        unit = item.attrs.get("unit", item.attrs.get("units", ""))
        unit = unit.decode() if isinstance(unit, bytes) else str(unit)
        own = name.rsplit("/", 1)[-1]
        key = f"{own}[{unit}]" if unit and "[" not in own else own
        if key in found:
            raise InputError(f"{path}: two datasets are called {own}; save each recording in a file of its own")
        found[key] = np.asarray(item)

    def read() -> None:
        with h5py.File(str(path), "r") as file:
            file.visititems(take)

    _opened(path, read)
    return [found]


ARRAYS: dict[str, Callable[[PathLike], list[dict[str, np.ndarray]]]] = {
    ".parquet": _parquet, ".h5": _datasets, ".hdf5": _datasets, ".mat": _matlab,
}  # fmt: skip


def _package(name: str, path: PathLike) -> Any:
    """A package of the extra `tables`; raise InputError with the command that installs the package."""
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"{path}: reading it needs {name.split('.')[0]}; install it with {INSTALL}") from None


def _opened(path: PathLike, read: Callable[[], Any]) -> Any:
    """The result of a package's reader; raise InputError for a damaged file."""
    try:
        return read()
    except InputError:
        raise
    # The packages raise exceptions of many kinds for a damaged file.
    except Exception as error:
        line = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: cannot be read ({type(error).__name__}: {line}); write the file again") from None
