"""One door for files: `load` and `save` choose the format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from herglotz.data.csv_format import read_csv, write_csv
from herglotz.data.files import PathLike, read_bytes
from herglotz.data.ibm_double_pendulum import looks_like_markers, read_ibm_double_pendulum
from herglotz.data.npz_format import read_npz, write_npz
from herglotz.data.schmidt_lipson import read_schmidt_lipson
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError

READS = (
    ".csv (t[s],q[rad],...; or six marker columns of the IBM double pendulum), .npz (arrays t, q, ...) and "
    "Schmidt & Lipson .txt (first line '% o v' or '% x v')"
)
WRITES = ".csv and .npz"


def load(
    path: PathLike,
    *,
    angles: str | Sequence[str] | None = None,  # coordinates that are angles; left out: what the file says; () for none
    unwrap: bool = True,  # make angles continuous
) -> Trajectories:
    """Read trajectories from any format that is known here.

    Returns
    -------
    Trajectories
        Angles unwrapped: no jump longer than π between samples.

    Raises
    ------
    InputError
        If the format is not known (the message lists those that are), or from the reader of that format.
    """
    found = _read(Path(path))
    if angles is not None:
        found = found.with_angles(angles)
    return found.unwrapped() if unwrap else found


def save(path: PathLike, trajectories: Trajectories) -> None:
    """Write trajectories as .csv or .npz, by the file's extension, atomically.

    Raises
    ------
    InputError
        If the extension is neither, or the file cannot be written.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".csv":
            write_csv(path, trajectories)
        case ".npz":
            write_npz(path, trajectories)
        case other:
            raise InputError(f"{path}: cannot write {other or 'a file without extension'}; written are {WRITES}")


def _read(path: Path) -> Trajectories:
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return read_npz(path)
    if suffix == ".csv":
        if looks_like_markers(read_bytes(path)[:200].decode("utf-8", "replace").split("\n")[0]):
            return read_ibm_double_pendulum(path)
        return read_csv(path)
    start = read_bytes(path).lstrip()[:1]
    if suffix == ".txt" and start == b"%":
        return read_schmidt_lipson(path)
    what = f"{suffix} whose first line does not start with %" if suffix == ".txt" else suffix or "no extension"
    raise InputError(f"{path}: {what} is not read here; what is read: {READS}")
