"""`load` and `save` choose the format of a file."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from herglotz.data.checks import check_alike
from herglotz.data.column_table import of_file
from herglotz.data.csv_columns import Names, Wanted, as_names
from herglotz.data.csv_dialect import is_row_of_numbers
from herglotz.data.csv_format import read_csv, write_csv
from herglotz.data.degrees import in_told_degrees
from herglotz.data.extra_formats import read_packed
from herglotz.data.files import PathLike, read_bytes
from herglotz.data.gaps import parted
from herglotz.data.input_terms import input_terms_of, with_input_terms
from herglotz.data.jumps import refuse_jumps
from herglotz.data.npz_format import read_npz, write_npz
from herglotz.data.polar import in_polar, named_by, pairs_of, with_hints
from herglotz.data.rows import Unusable
from herglotz.data.schmidt_lipson import read_schmidt_lipson
from herglotz.data.sensors import calibrated
from herglotz.data.table import left_out
from herglotz.data.trajectories import Trajectories
from herglotz.data.units import in_radians_and_seconds
from herglotz.errors import InputError
from herglotz.telling import tell


@dataclass(frozen=True)
class Format:
    """A kind of file: how to recognise the file, and the function that reads the file."""

    name: str  # for messages
    suffix: str
    read: Callable[..., Trajectories]
    is_table: bool = False  # whether columns can be chosen
    first_line: Callable[[str], bool] = lambda _: True  # whether the first line can belong to this format


# The first format that fits reads the file: a special format of a suffix stands before the general format.
FORMATS = (
    Format("arrays t, q, ... (.npz)", ".npz", read_npz),
    Format(
        "Schmidt & Lipson, first line '% o v' or '% x v' (.txt)", ".txt", read_schmidt_lipson, False,
        lambda line: line.startswith("%"),
    ),
    *(Format(f"t[s],q[rad],... ({end})", end, read_csv, True) for end in (".csv", ".txt", ".tsv", ".dat")),
    Format("columns as in csv (.parquet)", ".parquet", read_packed, True),
    Format("datasets t, q, ... (.h5, .hdf5)", ".h5", read_packed, True),
    Format("datasets t, q, ... (.h5, .hdf5)", ".hdf5", read_packed, True),
    Format("arrays t, q, ... of MATLAB (.mat)", ".mat", read_packed, True),
)  # fmt: skip
WRITES = ".csv and .npz"
SPREADSHEETS = (".xlsx", ".xls", ".xlsm", ".xlsb", ".ods", ".numbers")
PROSE = 65536  # bytes of a text file in which a recording has a row of numbers
SHOWN = 76  # characters of the note that names the files of a folder: a line of a terminal


def load(
    path: PathLike,
    *,
    angles: Names | bool | None = None,  # coordinates that are angles; left out: those in rad or deg; () for none
    degrees: Names | None = None,  # coordinates in degrees whose header does not say so; () for none
    polar: Names | None = None,  # pairs of positions, "x,y", that become one angle each; () for none
    input_terms: Names | None = None,  # squares, sizes, rates … of inputs that act as well; () for none
    unwrap: bool = True,  # make angles continuous
    show: bool = True,  # print the table of columns on stderr, where a table was read
    sensor_zeros: Sequence[float] | None = (),  # readings of the sensors at 0; see `herglotz.data.sensors`
    sensor_scales: Sequence[float] | None = (),  # position for a unit of each reading
    like: Trajectories | None = None,  # another recording: columns of the same names mean the same
    **columns: Any,  # of a table: time, coordinates, inputs, drop and group
) -> Trajectories:
    """Read trajectories from any of `FORMATS`, and print the role of each column of a table.

    Parameters
    ----------
    path
        .csv (or such a table in .txt, .tsv, .dat), .npz, .txt of Schmidt & Lipson, or with the extra `tables` .parquet,
        .h5 or .mat; or a folder of such files: each holds a recording, in the order of their names.
    angles
        Coordinates that are angles; True for all; left out: those in rad or deg; () for none.
    degrees
        Coordinates in degrees whose header gives no unit; () for none. Left out: columns without a unit that have the
        name of an angle and move too far between samples for an angle in rad, with a warning.
    polar
        Pairs of positions that become one angle each (`herglotz.data.polar`): "x,y" of a body on a circle, or
        ["x1,y1", "x2,y2"] of a chain, the second body on the first; "x,y,X,Y" with the centre in numbers or columns;
        "x,-y" where y grows downwards. Left out: as in `like`; () for none.
    input_terms
        Further inputs made of the recorded ones (`herglotz.data.input_terms`): "V^2", "|V|", "V'", "sat(V/2)",
        "tanh(V/2)". Left out: as in `like`.
    unwrap
        Make angles continuous.
    show
        Print the table of columns on stderr, where a table was read.
    sensor_zeros, sensor_scales
        Positions are scale · (reading − zero), both in the file's units: n numbers each, or n for each recording of the
        file, one recording after the other; after what the file itself says.
    like
        Another recording, such as `run.data`: columns of the same name have the same role, in the same order, and the
        same coordinates are angles, unless another argument says otherwise.
    **columns
        Of a table: time, coordinates, inputs, drop and group, each by column names; left out, the header decides.
        hold="zero", "first" or "smooth": the hold of the inputs between samples, which overrules the file's.
        motion=False if inputs alone are needed.

    Returns
    -------
    Trajectories
        Angles in rad, unwrapped: no jump longer than π between samples. Times in ms, µs, ns, min or h become s.

    Raises
    ------
    InputError
        If the format is not known (the message lists the known formats), or a coordinate that the user did not name
        moves in jumps alone; and as the reader of the format does.
    """
    columns.setdefault("known", () if like is None else like.columns)
    wanted = Wanted(**columns, positions=named_by(polar))
    files = _files(path := Path(path))
    files, sets, left = _usable(path, files, wanted)
    found = _joined(files, sets)
    found = replace(found, notes=(*found.notes, *left))
    if path.is_dir():
        which = f"{len(files)} recordings: {', '.join(file.name for file in files)}"
        found = replace(found, source=path.resolve().name, notes=(textwrap.shorten(which, SHOWN), *found.notes))
    found = as_told(found, wanted, polar, degrees, angles, like, input_terms)
    found = parted(calibrated(found, sensor_zeros, sensor_scales))
    if angles is not None:
        found = with_angles(found, angles)
    elif like is not None:
        found = angles_like(found, like)
    if show and found.columns:
        tell(found.table())
    return found.unwrapped() if unwrap else found


def as_told(
    found: Trajectories,  # as recorded, in rad and s where the header says so
    wanted: Wanted,
    polar: Names | None,
    degrees: Names | None,
    angles: Names | bool | None,
    like: Trajectories | None,
    input_terms: Names | None = None,
) -> Trajectories:
    """The coordinates and inputs that the columns are meant for: angles of bodies, and of degrees, terms of inputs.

    Refused where a coordinate jumps.
    """
    pairs = pairs_of(polar, like)
    chosen = polar is not None or wanted.coordinates is not None or wanted.known
    found = in_polar(found, pairs) if pairs or chosen else with_hints(found)
    refuse_jumps(found, wanted)
    terms = input_terms if input_terms is not None or like is None else input_terms_of(like.columns)
    return with_input_terms(in_told_degrees(found, degrees, angles, like), as_names(terms or ()))


def with_angles(found: Trajectories, angles: Names | bool) -> Trajectories:
    """The set with these coordinates as angles; True for all."""
    return found.with_angles((found.names if angles else ()) if isinstance(angles, bool) else angles)


def angles_like(found: Trajectories, other: Trajectories) -> Trajectories:
    """The set with the angles of another, among coordinates without a unit or in rad; not of degrees."""
    known = {} if other.degrees else dict(zip(other.names, other.angles, strict=True))
    rows = zip(found.names, found.units, found.angles, strict=True)
    return found.with_angles([name for name, unit, own in rows
                              if (known.get(name, own) if unit in ("1", "rad") else own)])  # fmt: skip


def save(path: PathLike, trajectories: Trajectories) -> None:
    """Write trajectories as .csv or .npz, by the file's extension, whole or not at all.

    Parameters
    ----------
    path
        The file; an existing file is overwritten.
    trajectories
        The set: times, positions, and s, p, u if the set has these, with their units.

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


def _files(path: Path) -> list[Path]:
    """The file itself, or the files of a folder that can be read."""
    if not path.is_dir():
        return [path]
    if (path / "model.pt").exists():
        raise InputError(f"{path}: is the folder of a run, not data; name a recording, or a folder of them")
    known = {one.suffix for one in FORMATS}
    every = (file for file in path.iterdir() if file.suffix.lower() in known and file.name[0] != ".")
    found = sorted(file for file in every if not _is_prose(file))
    if not found:
        raise InputError(f"{path}: is a folder without recordings; files end in {', '.join(sorted(known))}")
    return found


def _usable(
    path: Path, files: Sequence[Path], wanted: Wanted
) -> tuple[list[Path], list[Trajectories], tuple[str, ...]]:
    """The files that hold a recording, their recordings, and a warning of files whose recording is too short."""
    kept: list[Path] = []
    sets: list[Trajectories] = []
    wrong: list[Unusable] = []
    for file in files:
        try:
            sets.append(in_radians_and_seconds(_read(file, wanted)))
            kept.append(file)
        except Unusable as error:
            wrong.append(error)
        except InputError as error:
            if not path.is_dir():
                raise
            raise InputError(f"{error}; or take {file.name} out of the folder") from None
    return kept, sets, left_out(path, wrong, len(files))


def _is_prose(file: Path) -> bool:
    """Whether a text file beside recordings is none itself: a README, or a text without a row of numbers."""
    if file.suffix.lower() != ".txt" or not file.is_file():
        return False
    lines = read_bytes(file, PROSE).decode("utf-8", "replace").splitlines() if file.stat().st_size else []
    return file.stem.casefold() == "readme" or not any(map(is_row_of_numbers, lines))


def _joined(files: Sequence[Path], sets: Sequence[Trajectories]) -> Trajectories:
    """The joined set; notes that only some files have, and errors about differences, begin with the file's name."""
    for file, one in zip(files[1:], sets[1:], strict=True):
        try:
            check_alike([sets[0], one])
        except InputError as error:
            raise InputError(f"{file} beside {files[0].name}: {error}") from None
    shared = set(sets[0].notes).intersection(*(one.notes for one in sets))
    named = (
        replace(one, notes=tuple(note if note in shared else of_file(file.name, note) for note in one.notes))
        for file, one in zip(files, sets, strict=True)
    )
    return Trajectories.cat(named)


def _read(path: Path, wanted: Wanted) -> Trajectories:
    suffix = path.suffix.lower()
    line = read_bytes(path, 800).decode("utf-8", "replace").lstrip().split("\n")[0] if suffix != ".npz" else ""
    candidates = [one for one in FORMATS if one.suffix == suffix]
    for one in candidates:
        if one.first_line(line):
            if wanted and not one.is_table:
                raise InputError(f"{path}: columns are chosen in a table, such as a csv file; this is {one.name}")
            if one.is_table:
                return one.read(path, wanted)
            found = one.read(path)
            return replace(found, hold=wanted.hold) if wanted.hold else found
    what = f"a {suffix} file that begins like this" if candidates else suffix or "a file without extension"
    if suffix in SPREADSHEETS:
        raise InputError(
            f"{path}: is a spreadsheet; save the sheet as .csv (in Excel: Save as, CSV UTF-8), or hand over its "
            "table in Python: fit(pandas.read_excel(...))"
        )
    known = "; ".join(dict.fromkeys(one.name for one in FORMATS))
    raise InputError(f"{path}: cannot read {what}; known formats: {known}")
