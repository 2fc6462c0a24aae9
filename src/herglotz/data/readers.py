"""`load` and `save` choose the format of a file.

A coordinate that moves in jumps alone is a set point, which a table may hold under the name of a coordinate: `load`
refuses it.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data.checks import Unusable, check_alike
from herglotz.data.column_roles import is_usual
from herglotz.data.csv_columns import Names, Wanted, as_names
from herglotz.data.csv_format import has_samples, read_csv, write_csv
from herglotz.data.extra_formats import read_packed
from herglotz.data.files import PathLike, read_bytes, refuse_weights
from herglotz.data.gaps import complete, parted
from herglotz.data.input_terms import input_terms_of, with_input_terms
from herglotz.data.npz_format import read_npz, write_npz
from herglotz.data.polar import in_polar, named_by, pairs_of, with_hints
from herglotz.data.schmidt_lipson import read_schmidt_lipson
from herglotz.data.sensors import calibrated
from herglotz.data.table import usable
from herglotz.data.trajectories import GAP, Trajectories, made_alike, of_file
from herglotz.data.units import in_degrees, in_radians_and_seconds, with_angles_in_degrees
from herglotz.errors import InputError, refuse, tell

# Levels that the message names.
MAX_LEVELS = 4


def jumping(data: Trajectories) -> list[str]:
    """Names of the coordinates that stand still except for jumps.

    A mechanism that never moves in two steps in a row is slow, and goes from one level of its sensor to the next level.
    A set point leaps over a level that was recorded at another time, or has two levels in all. Steps over gaps do not
    count.
    """
    steps = data.steps()
    close = steps.h <= GAP * steps.h.median()
    rows = zip(data.names, data.q.T, strict=True)
    return [name for name, q in rows if _jumps(q, steps.index, close, steps.trajectory.diff() == 0)]


def _jumps(
    q: Tensor,  # (N,) one coordinate
    row: Tensor,  # (K,) sample at which each step starts
    close: Tensor,  # (K,) bool: no gap
    pair: Tensor,  # (K - 1,) bool: a step and the next step belong to one trajectory
) -> bool:
    """Whether a coordinate never moves in two steps in a row, and moves at least once between two steps at rest."""
    same = q[row + 1] == q[row]
    moves, still = close & ~same, close & same
    between = moves[1:-1] & still[:-2] & still[2:] & pair[:-1] & pair[1:]
    if bool((moves[:-1] & moves[1:] & pair).any()) or not bool(between.any()):
        return False
    levels, level = torch.unique(q, return_inverse=True)
    leaps = (level[row + 1] - level[row])[moves].abs() > 1
    return len(levels) == 2 or bool(leaps.any())


def refuse_jumps(data: Trajectories, wanted: Wanted) -> None:
    """Raise if a coordinate that the user has not named moves in jumps alone, because no model fits such a motion."""
    if wanted.coordinates is not None or not wanted.motion:
        return
    found = [name for name in jumping(complete(data)) if wanted.before(name) is None]
    if not found:
        return
    inputs = ",".join([*(name for name, _ in data.input_labels), *found])
    # Beside a column with a usual name, one without a unit may be a coordinate or not: the user says which are.
    usual = [name for name, unit in zip(data.names, data.units, strict=True) if is_usual(name, unit)]
    others = [name for name in data.names if name not in (*usual, *found)]
    places = [name for name in usual if name not in found]
    some = f", with those of {', '.join(others)} that are positions" if places and others else ""
    beside = f" and --coordinates {','.join(places)}{some}" if some else ""
    all_the_same = [name for name in data.names if name not in others] if some else data.names
    what = f"{', '.join(found)} {'moves' if len(found) == 1 else 'move'} in jumps alone ({_levels(data, found[0])})"
    raise InputError(
        f"{data.source or 'data'}: {what}; an input? --inputs {inputs} (inputs= in Python){beside}; a coordinate all "
        f"the same: --coordinates {','.join(all_the_same)}{some}"
    )


def _levels(data: Trajectories, name: str) -> str:
    """The first levels of a coordinate, in the unit of its column."""
    q = in_degrees(data, data.degrees).q[:, data.names.index(name)]
    seen = list(dict.fromkeys(f"{x:.4g}" for x in q.tolist()))
    return ", ".join(seen if len(seen) <= MAX_LEVELS else [*seen[:MAX_LEVELS], "…"])


@dataclass(frozen=True)
class Format:
    """A kind of file: its name in messages, its ending, its reader, and whether columns can be chosen.

    `begins` is how the first line begins where another format has the same ending.
    """

    name: str
    suffix: str
    read: Callable[..., Trajectories]
    is_table: bool = False
    begins: str = ""


# Endings of tables in text.
TEXTS = (".csv", ".txt", ".tsv", ".dat", ".lvm")
FORMATS = (
    Format("arrays t, q, ... (.npz)", ".npz", read_npz),
    Format("Schmidt & Lipson, first line '% o v' or '% x v' (.txt)", ".txt", read_schmidt_lipson, begins="%"),
    *(Format(f"t[s],q[rad],... ({end})", end, read_csv, True) for end in TEXTS),
    Format("columns as in csv (.parquet)", ".parquet", read_packed, True),
    Format("datasets t, q, ... (.h5, .hdf5)", ".h5", read_packed, True),
    Format("datasets t, q, ... (.h5, .hdf5)", ".hdf5", read_packed, True),
    Format("arrays t, q, ... of MATLAB (.mat)", ".mat", read_packed, True),
)
WRITERS = {".csv": write_csv, ".npz": write_npz}
SPREADSHEETS = (".xlsx", ".xls", ".xlsm", ".xlsb", ".ods", ".numbers")
# Characters of the note that names the files of a folder: a line of a terminal.
MAX_NOTE_LENGTH = 76


def load(
    path: PathLike,
    *,
    angles: Names | bool | None = None,
    degrees: Names | None = None,
    polar: Names | None = None,
    input_terms: Names | None = None,
    unwrap: bool = True,
    show: bool = True,
    sensor_zeros: Sequence[float] | None = (),
    sensor_scales: Sequence[float] | None = (),
    like: Trajectories | None = None,
    **columns: Any,
) -> Trajectories:
    """Read trajectories from any of `FORMATS`, and print the role of each column of a table.

    Parameters
    ----------
    path
        .csv (or such a table in .txt, .tsv, .dat, .lvm), .npz, or with the extra `tables` .parquet, .h5 or .mat; or a
        folder of such files: each holds a recording, in the order of their names.
    angles
        Coordinates that are angles; True for all; left out: those in rad or deg; () for none.
    degrees
        Coordinates in degrees whose header gives no unit; () for none. Left out: columns without a unit that have the
        name of an angle and move too far between samples for an angle in rad, with a warning.
    polar
        Pairs of positions that become one angle each (`herglotz.data.polar`): "x,y" of a body on a circle, or
        ["x1,y1", "x2,y2"] of a chain, the second body on the first; "x,y,X,Y" with the centre in numbers or columns;
        "x,y,X,Y,r" keeps the distance r; "x,-y" where y grows downwards. Left out: as in `like`; () for none.
    input_terms
        Further inputs made of the recorded inputs (`herglotz.data.input_terms`): "V^2", "|V| V", "|V|", "V'",
        "sat(V/2)", "tanh(V/2)". Left out: as in `like`; () for none.
    unwrap
        Make angles continuous.
    show
        Print the table of columns on stderr, where a table was read, or else the notes.
    sensor_zeros, sensor_scales
        Positions are scale · (reading − zero), both in the file's units: n numbers each, or n for each recording of the
        file, one recording after the other. The comments of the file act first.
    like
        Another recording, such as `run.data`: columns of the same name have the same role, in the same order, the same
        coordinates are angles, and inputs have the same hold, unless another argument or the file says otherwise.
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
    columns = ({} if like is None else {"known": like.columns, "known_hold": like.hold}) | columns
    wanted = Wanted(**columns, positions=named_by(polar))
    path = Path(path)
    found = _read_folder(path, wanted) if path.is_dir() else _read(path, wanted)
    found = as_meant(found, wanted, polar, degrees, angles, like, input_terms)
    if angles is None and like is not None:
        found = angles_like(found, like)
    found = finished(found, angles, sensor_zeros, sensor_scales)
    if show:
        for text in [found.table()] if found.columns else [f"{found.source}: {note}" for note in found.notes]:
            tell(text)
    return found.unwrapped() if unwrap else found


def as_meant(
    found: Trajectories,
    wanted: Wanted,
    polar: Names | None,
    degrees: Names | None,
    angles: Names | bool | None,
    like: Trajectories | None,
    input_terms: Names | None,
) -> Trajectories:
    """The recorded set with angles of pairs of positions, angles in degrees converted to rad, and terms of inputs.

    Raise InputError if a coordinate that the user did not name moves in jumps alone.
    """
    pairs = pairs_of(polar, like)
    recorded, found = found, in_polar(found, pairs)
    if not (wanted.coordinates is not None or wanted.known or (polar is not None and not pairs)):
        found = with_hints(found, recorded, pairs)
    refuse_jumps(found, wanted)
    if input_terms is None and like is not None:
        input_terms = input_terms_of(like.columns)
    return with_input_terms(with_angles_in_degrees(found, degrees, angles, like), as_names(input_terms or ()))


def finished(
    found: Trajectories,
    angles: Names | bool | None,
    zeros: Sequence[float] | None,
    scales: Sequence[float] | None,
) -> Trajectories:
    """The set with a user's zeros and scales of sensors, cut at long gaps, and with these angles; True for all."""
    found = parted(calibrated(found, zeros, scales))
    if isinstance(angles, bool):
        angles = found.names if angles else ()
    return found if angles is None else found.with_angles(angles)


def angles_like(found: Trajectories, other: Trajectories) -> Trajectories:
    """The set in which coordinates without a unit, or in rad, are angles if they are angles in the other set.

    A set that was recorded in degrees says nothing of angles here.
    """
    known = {} if other.degrees else dict(zip(other.names, other.angles, strict=True))
    rows = zip(found.names, found.units, found.angles, strict=True)
    return found.with_angles(
        [name for name, unit, angle in rows if (known.get(name, angle) if unit in ("1", "rad") else angle)]
    )


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
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        kind = suffix or "a file without extension"
        raise InputError(f"{path}: cannot write {kind}; written are {' and '.join(WRITERS)}")
    WRITERS[suffix](path, trajectories)


def _files_of(folder: Path) -> tuple[list[Path], tuple[str, ...]]:
    """The files of a folder that may hold recordings, in order; a warning that names files of text without samples."""
    known = {one.suffix for one in FORMATS}
    every = sorted(file for file in folder.iterdir() if file.suffix.lower() in known and file.name[0] != ".")
    files = [file for file in every if file.suffix.lower() not in TEXTS or has_samples(file)]
    if not files:
        raise InputError(f"{folder}: is a folder without recordings; files end in {', '.join(sorted(known))}")
    notes = ", ".join(file.name for file in every if file not in files)
    return files, (f"warning: left out of the folder, for no line has two numbers: {notes}",) if notes else ()


def _read_folder(path: Path, wanted: Wanted) -> Trajectories:
    """The recordings of a folder, file by file, with a note of their names, and a warning of unusable recordings."""
    if (path / "model.pt").exists():
        raise InputError(f"{path}: is the folder of a run, not data; name a recording, or a folder of them")
    files, left_out = _files_of(path)

    def read(wanted: Wanted, file: Path) -> tuple[Path, Trajectories]:
        try:
            return file, _read(file, wanted)
        except Unusable:
            raise
        except InputError as error:
            raise InputError(f"{error}; or take {file.name} out of the folder") from None

    pairs, warnings = usable(path, files, partial(read, wanted))
    # A column that is the same in every row of one file may move in another.
    sets = [one for _, one in pairs]
    columns = [{name for name, *_ in one.columns} for one in sets]
    moving = [name for name in dict.fromkeys(x for one in sets for x in one.names) if all(name in x for x in columns)]
    if any(name not in one.names for one in sets for name in moving):
        wanted = replace(wanted, positions=(*wanted.positions, *moving))
        pairs, warnings = usable(path, files, partial(read, wanted))
    names = f"{len(pairs)} recordings: {', '.join(file.name for file, _ in pairs)}"
    found = _joined(*zip(*pairs, strict=True))
    told = (textwrap.shorten(names, MAX_NOTE_LENGTH), *found.notes, *warnings, *left_out)
    return replace(found, source=path.resolve().name, notes=told)


def _joined(files: Sequence[Path], sets: Sequence[Trajectories]) -> Trajectories:
    """The joined set; notes that only some files have, and errors about differences, begin with the file's name."""
    sets = made_alike(sets)
    for file, one in zip(files[1:], sets[1:], strict=True):
        try:
            check_alike([sets[0], one])
        except InputError as error:
            raise InputError(f"{file} beside {files[0].name}: {error}") from None
    shared = set(sets[0].notes).intersection(*(one.notes for one in sets))
    named = (
        replace(
            one,
            notes=tuple(note if note in shared else of_file(file.name, note) for note in one.notes),
            recordings=tuple(f"{file.name}, {name}" for name in one.recordings) or (file.name,) * len(one),
        )
        for file, one in zip(files, sets, strict=True)
    )
    return Trajectories.cat(named)


def _read(path: Path, wanted: Wanted) -> Trajectories:
    """The recording of a file, by the format of its ending, in rad and s."""
    suffix = path.suffix.lower()
    formats = [one for one in FORMATS if one.suffix == suffix]
    if not formats:
        spreadsheet = (
            f"{path}: is a spreadsheet; save the sheet as .csv (in Excel: Save as, CSV UTF-8), or hand over its "
            "table in Python: fit(pandas.read_excel(...))"
        )
        refuse({spreadsheet: suffix in SPREADSHEETS})
        refuse_weights(path)
        known = "; ".join(dict.fromkeys(one.name for one in FORMATS))
        raise InputError(f"{path}: cannot read {suffix or 'a file without extension'}; known formats: {known}")
    # An absent or empty file, a folder or a pipe is refused here for all readers.
    begin = read_bytes(path, 1).decode("latin-1")
    one = next(one for one in formats if begin.startswith(one.begins))
    if one.is_table:
        return in_radians_and_seconds(one.read(path, wanted))
    refuse({f"{path}: columns are chosen in a table, such as a csv file; this is {one.name}": wanted})
    found = in_radians_and_seconds(one.read(path))
    return replace(found, hold=wanted.hold) if wanted.hold else found
