"""`load` and `save` choose the format of a file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from herglotz.data.csv_format import read_csv, write_csv
from herglotz.data.files import PathLike, read_bytes
from herglotz.data.ibm_double_pendulum import looks_like_markers, read_ibm_double_pendulum
from herglotz.data.npz_format import read_npz, write_npz
from herglotz.data.schmidt_lipson import read_schmidt_lipson
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError


@dataclass(frozen=True)
class Format:
    """One kind of file: how to recognise it, and what reads it."""

    name: str  # as messages say it
    suffix: str
    read: Callable[[Path], Trajectories]
    first_line: Callable[[str], bool] = lambda _: True  # whether the first line can belong to this format


# The first format that fits reads the file: a special case of a suffix stands before the general one.
FORMATS = (
    Format("IBM double pendulum, six marker columns (.csv)", ".csv", read_ibm_double_pendulum, looks_like_markers),
    Format("t[s],q[rad],... (.csv)", ".csv", read_csv),
    Format("arrays t, q, ... (.npz)", ".npz", read_npz),
    Format(
        "Schmidt & Lipson, first line '% o v' or '% x v' (.txt)", ".txt", read_schmidt_lipson,
        lambda line: line.startswith("%"),
    ),
)  # fmt: skip
WRITES = ".csv and .npz"


def load(
    path: PathLike,
    *,
    angles: str | Sequence[str] | None = None,  # coordinates that are angles; left out: what the file says; () for none
    unwrap: bool = True,  # make angles continuous
) -> Trajectories:
    """Read trajectories from any of `FORMATS`.

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
    line = read_bytes(path)[:200].decode("utf-8", "replace").lstrip().split("\n")[0] if suffix != ".npz" else ""
    candidates = [one for one in FORMATS if one.suffix == suffix]
    for one in candidates:
        if one.first_line(line):
            return one.read(path)
    what = f"a {suffix} file that begins like this" if candidates else suffix or "a file without extension"
    raise InputError(f"{path}: cannot read {what}; known formats: {'; '.join(one.name for one in FORMATS)}")
