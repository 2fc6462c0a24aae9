"""Trajectories as a NumPy archive: exact, compact, never unpickled."""

from __future__ import annotations

import io
import json
import zipfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import torch
from torch import Tensor

from herglotz.data.checks import ARRAYS, EXACT, quote
from herglotz.data.files import PathLike, read_bytes, write_atomically
from herglotz.data.gaps import with_missing
from herglotz.data.holds import last_read
from herglotz.data.marks import without_marks
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError, refuse
from herglotz.schema import check_entries

# Names of the arrays that are read from an archive.
USED = (*ARRAYS, "lengths", "metadata")
# The arrays of an archive may take this many bytes: 67 million samples of t and three coordinates.
MAX_BYTES = 2**31


class Metadata(TypedDict, total=False):
    """The metadata of an archive: fields of `Trajectories`; each of the `columns` is a name, a role and a unit."""

    names: list[str]
    units: list[str]
    angles: list[bool]
    time_unit: str
    source: str
    hold: str
    delay: float | None
    lag: float | None
    columns: list[tuple[str, str, str]]
    recordings: list[str]


LABELS = tuple(Metadata.__annotations__)


def read_npz(path: PathLike) -> Trajectories:
    """Read trajectories from a .npz archive.

    Arrays `t` (N,) and `q` (N, n) or (N,) are needed; `lengths` (B,), `s` (N,), `p` (N, n), `u` (N, m) and `metadata`
    (a JSON object with names, units, angles, time_unit, source, hold, delay, lag, columns, recordings) may follow.
    Integer arrays become float64. Marks of missing readings (`herglotz.data.marks`) count as missing, with a warning,
    unless the archive has metadata: an archive of `write_npz` has metadata and is read as it was written. Raise
    InputError that names the file, the array, the fault and the remedy.
    """
    return trajectories_of(read_bytes(path), Path(path))


def trajectories_of(content: bytes, path: Path) -> Trajectories:
    """The trajectories in the bytes of an archive, as `read_npz`; the path is for messages."""
    arrays = _arrays(path, content)
    for name in ("t", "q"):
        if name not in arrays:
            found = ", ".join(name if name.isprintable() else quote(name) for name in sorted(arrays)) or "none"
            raise InputError(f"{path}: there is no array {name!r}, only {found}; add it: numpy.savez(..., {name}=...)")
    labels = _labels(path, arrays.get("metadata"))
    numbers = {name: _floating(path, name, arrays[name]) for name in ARRAYS if name in arrays}
    lengths = arrays.get("lengths")
    if lengths is not None and (lengths.dtype.kind not in "iu" or lengths.ndim != 1):
        raise InputError(f"{path}: array 'lengths' must hold integers in one row, got {lengths.dtype} {lengths.shape}")
    found = Trajectories.of(
        **numbers, lengths=None if lengths is None else lengths.tolist(), **{"source": path.name, **labels}
    )
    return found if "metadata" in arrays or found.observed is not None else _without_marks(found)


def _without_marks(data: Trajectories) -> Trajectories:
    """The set without the marks of missing readings, and a warning for each mark.

    Positions that are marks are missing; inputs that are marks are held from the sample before.
    """
    parts = [x.double().numpy() for x in (data.t[:, None], data.q, data.u) if x is not None]
    labels = [(name, False) for name in data.names] + [(name, True) for name, _ in data.input_labels]
    columns = [(k, name, is_input) for k, (name, is_input) in enumerate(labels, 1)]
    table, notes = without_marks(np.hstack(parts), data.trajectory.tolist(), range(data.samples), columns)
    if not notes:
        return data
    numbers = torch.from_numpy(table[:, 1:]).to(data.q)
    q, u = numbers[:, : data.dof], numbers[:, data.dof :]
    u = last_read(u, ~u.isnan(), data.trajectory)
    inputs = None if data.u is None else u.nan_to_num(nan=0.0)
    found = replace(data, u=inputs, notes=(*data.notes, *notes))
    return with_missing(found, ~q.isnan(), lambda k: f"sample {k}", u.isnan().any(1))


def write_npz(path: PathLike, trajectories: Trajectories) -> None:
    """Write every array and label, whole or not at all; `read_npz` returns a set with the same digest.

    Raise InputError if the file cannot be written.
    """
    write_atomically(path, npz_bytes(trajectories))


def npz_bytes(trajectories: Trajectories) -> bytes:
    """The bytes of the archive."""
    arrays = {name: x.detach().cpu().numpy() for name in ARRAYS if (x := getattr(trajectories, name)) is not None}
    metadata = json.dumps({label: getattr(trajectories, label) for label in LABELS})
    buffer = io.BytesIO()
    np.savez_compressed(buffer, lengths=np.array(trajectories.lengths), metadata=np.array(metadata), **arrays)
    return buffer.getvalue()


def _arrays(path: Path, content: bytes) -> dict[str, np.ndarray]:
    """The arrays of an archive by name. Those that are not `USED` stay empty: they may unpack to gigabytes of zeros."""
    if not content.startswith(b"PK"):
        raise InputError(f"{path}: is not a .npz archive; write it with numpy.savez or herglotz.data.save")
    arrays: dict[str, np.ndarray] = {}
    name = ""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            _check_size(path, archive.zip)
            for name in archive.files:
                arrays[name] = np.asarray(archive[name]) if name in USED else np.empty(0)
    except InputError:
        raise
    # numpy and zipfile raise exceptions of many kinds for a damaged archive.
    except Exception as error:
        if "allow_pickle" in str(error):
            raise InputError(
                f"{path}: array {name!r} holds Python objects, which are never loaded; save plain numbers"
            ) from error
        what = f"array {name!r}" if name else "the archive"
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(f"{path}: {what} is damaged ({reason}); write the file again") from error
    return arrays


def _check_size(path: Path, archive: zipfile.ZipFile) -> None:
    """Raise InputError if the arrays take more than `MAX_BYTES`, before they take memory."""
    size = sum(one.file_size for one in archive.infolist() if one.filename.removesuffix(".npy") in USED)
    memory = f"{size / 2**30:.1f} GB of memory, more than {MAX_BYTES / 2**30:.0f}"
    refuse({f"{path}: its arrays take {memory}; save fewer samples": size > MAX_BYTES})


def _floating(path: Path, name: str, x: np.ndarray) -> Tensor:
    """An array of float32 or float64 unchanged, an array of integers in float64."""
    if x.dtype.kind in "iu":
        if x.size and max(abs(int(x.min())), abs(int(x.max()))) > EXACT:
            raise InputError(
                f"{path}: array {name!r} has integers above 2^53, which float64 would round; subtract the first one"
            )
        return torch.from_numpy(x.astype(np.float64))
    if x.dtype.kind != "f" or x.dtype.itemsize not in (4, 8):
        raise InputError(f"{path}: array {name!r} has dtype {x.dtype}; save it as float64")
    return torch.from_numpy(x.astype(x.dtype.newbyteorder("=")))


def _labels(path: Path, metadata: np.ndarray | None) -> dict:
    """The labels in the metadata, with the types of the fields of `Trajectories`."""
    if metadata is None:
        return {}
    labels: Any = None
    with suppress(ValueError, RecursionError):
        # numpy's str takes any number for a character; Python then fails on a number beyond Unicode.
        order = "be" if metadata.dtype.byteorder == ">" else "le"
        labels = json.loads(metadata.tobytes().decode(f"utf-32-{order}").rstrip("\0"))
    check_entries(Metadata, labels, f"{path}: 'metadata' (a JSON object)", "write it again or drop it")
    known = {name: labels[name] for name in LABELS if name in labels}
    return {**known, "columns": tuple(map(tuple, known.get("columns", [])))}
