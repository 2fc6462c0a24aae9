"""`Trajectories` from the columns of a table: a csv file or a DataFrame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, time
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from herglotz.data.checks import EXACT, MIN_SAMPLES, Unusable, numbers_runs, out_of_order, quote
from herglotz.data.csv_columns import HEADER_DECIDES, Columns, Wanted, assign, is_number
from herglotz.data.gaps import with_missing
from herglotz.data.header_cells import name_and_unit
from herglotz.data.rates import Recording, completed, in_order, without_repeats
from herglotz.data.trajectories import Trajectories
from herglotz.data.units import PER_SECOND, in_seconds
from herglotz.errors import InputError, refuse

# 3000 years: a time of so many counts milliseconds, or smaller units, since 1970.
MAX_SECONDS = 1e11
Item = TypeVar("Item")
Read = TypeVar("Read")


def from_table(
    path: Path,
    columns: Columns,
    at: Sequence[int],  # (N,) row number of each sample in the file, for messages
    labels: Sequence[str],  # (N,) trajectory of each sample
    values: Any,  # (N, columns.numeric) numbers; NaN where a coordinate, s, a momentum or an input is missing
    with_settings: Callable[[Trajectories], Trajectories] = lambda found: found,
) -> Trajectories:
    """Group the rows into trajectories; a coordinate in rad is taken for an angle.

    A row in which some coordinates are missing keeps the others (`herglotz.data.gaps`). Rows without any coordinate are
    left out, and a note gives their number: the step over these rows is longer, with the mean of the inputs
    (`herglotz.data.rates`). A trajectory that is too short, or whose time does not increase, is left out with a
    warning. `with_settings` adds the settings in the comments of a file. Raise InputError, which begins with `path`, if
    most trajectories are unusable.
    """
    values = np.asarray(values, dtype=np.float64).reshape(len(at), len(columns.numeric))
    columns, values = _without_blank(columns, values)
    recordings = _recordings(path, labels, np.asarray(at), values)
    blank = bool(np.isnan(values).any())
    recordings, repairs = _with_clocks(recordings, blank, columns.units[columns.time] or "s")
    recordings, unordered = usable(path, recordings, lambda one: _in_time(path, columns, one))
    found = with_settings(_trajectories(path, columns, recordings))
    if not blank:
        return replace(found, notes=(*found.notes, *repairs, *unordered))
    recordings, filled, hold = completed(recordings, columns, found.hold)
    recordings, too_few = usable(path, recordings, lambda one: _with_enough(path, columns, one))
    found = with_settings(_trajectories(path, columns, recordings))
    found = replace(found, hold=hold, notes=(*found.notes, *repairs, *unordered, *filled, *too_few))
    return _with_missing(found, columns, recordings)


def group_by_values(
    columns: Columns,
    wanted: Wanted,
    values: Any,  # (N, columns.numeric), as in `from_table`
    labels_of: Callable[[int], list[str]],
) -> str:
    """The column that numbers the recordings by its values, where no name says so and time starts anew; "" for none.

    The column has a value of its own between two falls of the time. The user's columns keep their role, and so do
    inputs: a constant input is one. Rows of stacked tables, which are sorted by time, are one recording.
    """
    values = np.asarray(values, dtype=np.float64).reshape(-1, len(columns.numeric))
    anew = np.diff(values[:, 0]) < 0
    if columns.trajectory is not None or not anew.any():
        return ""
    if not (np.diff(in_order(Recording("", np.arange(len(values)), values)).values[:, 0]) < 0).any():
        return ""
    given = {columns.time, columns.s, *columns.p, *columns.u}
    free = [
        i for i, name in enumerate(columns.names)
        if i not in given and wanted.role(name) is None and wanted.before(name) in (None, "dropped")
    ]  # fmt: skip
    for i in sorted(free, key=lambda i: i not in columns.q):
        if numbers_runs(np.array(labels_of(i)), anew):
            return columns.names[i]
    return ""


def grouped_by_guess(found: Trajectories, group: str) -> Trajectories:
    """The set with a warning that a column was taken for the number of the recording by its values."""
    note = (
        f"warning: {group} is taken for the number of the recording, but by its values alone: it changes wherever time "
        "starts anew, and nowhere else; if another column numbers the recordings, give --group NAME (group= in Python)"
    )
    return replace(found, notes=(*found.notes, note))


def _with_missing(found: Trajectories, columns: Columns, recordings: Sequence[Recording]) -> Trajectories:
    """The set with interpolated positions and without the rows that have no position, or miss another value."""
    missing = np.isnan(np.concatenate([one.values for one in recordings]))
    if not missing.any():
        return found
    rows, q = np.concatenate([one.at for one in recordings]), slice(1, 1 + len(columns.q))

    def place(k: int) -> str:
        return f"row {rows[k]}, column '{columns.names[columns.numeric[missing[k].argmax()]]}'"

    lacking = torch.from_numpy(np.delete(missing, q, 1).any(1))
    return with_missing(found, torch.from_numpy(~missing[:, q]), place, lacking)


def _without_blank(columns: Columns, values: np.ndarray) -> tuple[Columns, np.ndarray]:
    """The columns, and their numbers, without coordinates that have no value in any row, as columns of remarks.

    A warning names these coordinates. All columns stay if no coordinate would be left, or if momenta are recorded.
    """
    gone = {i for k, i in enumerate(columns.numeric) if len(values) and i in columns.q and np.isnan(values[:, k]).all()}
    if not gone or columns.p or not (q := tuple(i for i in columns.q if i not in gone)):
        return columns, values
    has, are = ("has", "is") if len(gone) == 1 else ("have", "are")
    names = ", ".join(columns.names[i] for i in sorted(gone))
    note = f"warning: {names} {has} no value in any row, and {are} left aside"
    kept = [i not in gone for i in columns.numeric]
    return replace(columns, q=q, notes=(*columns.notes, note)), values[:, kept]


def _with_clocks(recordings: list[Recording], blank: bool, unit: str) -> tuple[list[Recording], list[str]]:
    """The recordings sorted by time, without repeated stamps, and a note on the first repair and the number of others.

    Only rows with blank cells may be stacked tables, whose rows have to be sorted.
    """
    made = [without_repeats(in_order(one) if blank else one, unit) for one in recordings]
    notes = [note for _, note in made if note]
    more = f", and so of {len(notes) - 1} more recordings" if len(notes) > 1 else ""
    return [one for one, _ in made], [f"{note}{more}" for note in notes[:1]]


def usable(path: Path, items: Sequence[Item], read: Callable[[Item], Read]) -> tuple[list[Read], tuple[str, ...]]:
    """The results of `read`, without those of unusable recordings, and a warning that counts these recordings.

    Raise the first error if most recordings are unusable.
    """
    kept: list[Read] = []
    wrong: list[Unusable] = []
    for item in items:
        try:
            kept.append(read(item))
        except Unusable as error:
            wrong.append(error)
    if not wrong:
        return kept, ()
    if 2 * len(wrong) > len(items):
        raise wrong[0]
    why = str(wrong[0]).removeprefix(f"{path}, ").removeprefix(f"{path}: ").partition(";")[0]
    are = "is left out: " if len(wrong) == 1 else "are left out: the first: "
    return kept, (f"warning: {len(wrong)} of {len(items)} recordings {are}{why}",)


def _recordings(path: Path, labels: Sequence[str], at: np.ndarray, values: np.ndarray) -> list[Recording]:
    """The rows of each trajectory, in order of first appearance; raise InputError if there is no row."""
    refuse({f"{path}: there is a header but no samples; add at least {MIN_SAMPLES} rows": not len(at)})
    groups: dict[str, list[int]] = {}
    for i, label in enumerate(labels):
        groups.setdefault(label, []).append(i)
    return [Recording(label, at[rows], values[rows]) for label, rows in groups.items()]


def _in_time(path: Path, columns: Columns, one: Recording) -> Recording:
    """The recording; raise Unusable unless it has three rows, in order of time."""
    t, label, clock = one.values[:, 0], "", columns.names[columns.time]
    if columns.trajectory is not None:
        label = columns.names[columns.trajectory]
    if len(t) < MIN_SAMPLES:
        has = f"has {len(t)} sample{'s' if len(t) > 1 else ''}, at least {MIN_SAMPLES} are needed"
        where = f"{path}, row {one.at[0]}"
        if one.label:
            raise Unusable(f"{where}, column '{label}': {quote(one.label)} {has}; delete it or add rows")
        raise Unusable(f"{where}: the file {has}; add rows")
    back = ~(np.diff(t) > 0)
    if back.any():
        k = int(back.argmax())
        raise Unusable(
            f"{path}, row {one.at[k + 1]}, column '{clock}': {float(t[k + 1])!r} does not increase on {float(t[k])!r} "
            f"in row {one.at[k]}; {out_of_order(one.values, back, [columns.names[i] for i in columns.numeric])}"
        )
    return one


def _with_enough(path: Path, columns: Columns, one: Recording) -> Recording:
    """The recording; raise Unusable unless three rows have all their values."""
    gone = np.isnan(one.values)
    if (known := int((~gone.any(1)).sum())) < MIN_SAMPLES:
        name = columns.names[columns.numeric[int(gone.sum(0).argmax())]]
        raise Unusable(
            f"{path}, row {one.at[0]}: of the {len(gone)} rows from here, {known} have a value in every column, at "
            f"least {MIN_SAMPLES} are needed; column '{name}' has the most gaps: leave it out with --drop {name} "
            "(drop= in Python), or fill it in"
        )
    return one


def _trajectories(path: Path, columns: Columns, recordings: Sequence[Recording]) -> Trajectories:
    """The set of these recordings, a sample a row, with 0 for a missing value."""
    table = np.nan_to_num(np.concatenate([one.values for one in recordings]))
    lengths = tuple(len(one.values) for one in recordings)
    widths = [1, len(columns.q), 0 if columns.s is None else 1, len(columns.p), len(columns.u)]
    t, q, s, p, u = np.split(table, np.cumsum(widths)[:-1], axis=1)
    name, last = columns.names[columns.time], float(t[-1, 0])
    since_1970 = (
        f"{path}: {name} of {last:.4g} without a unit is no time in s; write its unit, {name}[ms] or {name}[us]"
    )
    refuse({since_1970: last > MAX_SECONDS and not columns.units[columns.time]})
    units = tuple(columns.units[i] or "1" for i in columns.q)
    group = "" if columns.trajectory is None else columns.names[columns.trajectory]
    found = Trajectories.of(
        t[:, 0],
        q,
        lengths,
        names=tuple(columns.names[i] for i in columns.q),
        units=units,
        angles=tuple(unit == "rad" for unit in units),
        s=s[:, 0] if s.size else None,
        p=p if p.size else None,
        u=u if u.size else None,
        time_unit=columns.units[columns.time] or "s",
        hold=columns.hold if columns.u else "",
        source=path.name,
        columns=columns.roles(),
        recordings=[f"{group} {one.label}" for one in recordings] if group else (),
    )
    return replace(found, notes=columns.notes)


def from_frame(frame: Any, wanted: Wanted = HEADER_DECIDES, where: Path = Path("DataFrame")) -> Trajectories:
    """Read a pandas DataFrame (or anything with `columns` and `frame[name]`) like a csv file with that header.

    `where` begins messages. The index of a DataFrame joins the columns, unless the index merely counts the rows.
    InputError names column, row (counted from 0), value and remedy.
    """
    frame = _with_index(frame)
    raw = [plain(frame[name], f"{where}, column {quote(str(name))}: numbers") for name in frame.columns]
    heads, first = _heads(frame, raw, where, wanted)
    columns, raw = assign(heads, str(where), wanted), [column[first:] for column in raw]
    times = raw[columns.time]
    raw[columns.time] = clock = seconds(times)
    every = [_numbers(where, columns.names[i], raw[i], i == columns.time, first) for i in columns.numeric]
    values = np.stack(every, 1)
    if group := group_by_values(columns, wanted, values, lambda i: list(map(str, raw[i]))):
        return grouped_by_guess(from_frame(frame, replace(wanted, group=group), where), group)
    labels = [""] * len(clock) if columns.trajectory is None else list(map(str, raw[columns.trajectory]))
    found = from_table(where, columns, range(first, first + len(clock)), labels, values)
    if clock is times:
        return found
    return in_dates(found, "" if times.dtype.kind == "m" else "date")


def _heads(frame: Any, raw: Sequence[np.ndarray], where: Path, wanted: Wanted) -> tuple[list[str], int]:
    """The header of a frame, and its first row of numbers: row 1 if row 0 holds units, as in csv files."""
    if (rows := _two_rows(list(frame.columns))) and (named := with_units(*rows, str(where), wanted)):
        return named, 0
    heads = [str(name) for name in frame.columns]
    below = [_text(column[0]) for column in raw if column.ndim == 1 and len(column)]
    named = with_units(heads, below, str(where), wanted)
    return (heads, 0) if named is None else (named, 1)


def with_units(cells: Sequence[str], below: Sequence[str], where: str, wanted: Wanted) -> list[str] | None:
    """The header's cells as `name[unit]` with the units of the row below; None if that row holds no units.

    The row holds units if no cell is a number, and the cell of the time is a unit of time. Raise InputError, which
    begins with `where` (file and row), if a name has different units in the header and below, or as
    `herglotz.data.csv_columns.assign`.
    """
    units = [_bare(cell) for cell in below]
    if len(units) != len(cells) or not {"s", *PER_SECOND}.intersection(units) or any(map(_is_sample, units)):
        return None
    own = [(name_and_unit(cell) or ("", ""))[1] for cell in cells]
    named = list(zip(cells, units, own, strict=True))
    both = [f"{cell!r} and below it {unit!r}" for cell, unit, head in named if head and unit not in ("", head)]
    refuse({f"{where}: two units of one column, {both and both[0]}; keep one of them": both})
    found = [f"{cell}[{unit}]" if unit and not head else cell for cell, unit, head in named]
    clock = assign(found, where, wanted).time
    return found if units[clock] in ("s", *PER_SECOND) else None


def _bare(cell: str) -> str:
    """A unit without brackets; a dash stands for no unit."""
    return cell.strip("[]()<> ").removesuffix("-")


def _is_sample(unit: str) -> bool:
    """Whether a cell is a number; 1 may be the unit of plain numbers instead."""
    return is_number(unit) and unit != "1"


def _two_rows(names: Sequence[Any]) -> tuple[list[str], list[str]] | None:
    """Names and units of a header of two rows, which pandas holds as pairs; None for any other header."""
    if not all(isinstance(name, tuple) and len(name) == 2 for name in names):
        return None
    units = [str(unit) for _, unit in names]
    return [str(name) for name, _ in names], ["" if x.startswith("Unnamed: ") else x for x in units]


def _text(x: Any) -> str:
    """The kind of a cell as text: "0" for any number, blank for a missing value, and other text unchanged."""
    return x if isinstance(x, str) else "" if x is None or x != x else "0"


def in_dates(found: Trajectories, unit: str = "date") -> Trajectories:
    """The set with its times in s, as dates and durations are whatever the header says; `unit` joins the table."""
    roles = ((name, role, (unit or own) if role == "time" else own) for name, role, own in found.columns)
    return replace(in_seconds(found), t=found.t, time_unit="s", columns=tuple(roles))


def plain(x: Any, what: str = "numbers") -> np.ndarray:
    """Values as an array, with NaN for masked values and pandas' NA; messages call the values `what`.

    Raise InputError if the values are complex.
    """
    array = np.ma.filled(x.astype(np.float64), np.nan) if isinstance(x, np.ma.MaskedArray) else np.asarray(x)
    refuse({f"{what} are complex; give their real parts, x.real": np.iscomplexobj(array)})
    if array.dtype.kind == "O" and any(gaps := [type(x).__name__ == "NAType" for x in array.flat]):
        # The user's own array stays as it is.
        array = array.copy()
        array.flat[np.flatnonzero(gaps)] = np.nan
    return array


def seconds(column: np.ndarray) -> np.ndarray:
    """Times in seconds: of dates since the first date, of durations their length; any other column unchanged.

    Raise InputError if some dates have a time zone and others have none.
    """
    if column.dtype.kind in "OU" and len(column) and all(isinstance(x, str) for x in column):
        dates = [None if is_number(x) else moment(x) for x in column]
        column = column if None in dates else np.array(dates, dtype=object)
    if column.dtype.kind == "O" and len(column) and isinstance(column[0], datetime):
        try:
            return np.array([(x - column[0]).total_seconds() for x in column])
        except (TypeError, AttributeError):
            raise InputError("times are not all dates, or not all with a time zone; write them alike") from None
    if column.dtype.kind in "Mm":
        return (column - column[:1] if column.dtype.kind == "M" else column) / np.timedelta64(1, "s")
    return column


def _with_index(frame: Any) -> Any:
    """A DataFrame with its index as columns: a named index by its name, unnamed dates or floats as the time."""
    index = getattr(frame, "index", None)
    if index is None or not hasattr(frame, "reset_index"):
        return frame
    if any(name is not None for name in index.names):
        return frame.reset_index()
    is_clock = index.dtype.kind in "Mmf" and not {"t", "time"} & set(map(str, frame.columns))
    return frame.rename_axis("time").reset_index() if is_clock else frame


def moment(text: str) -> datetime | None:
    """A date with time in ISO 8601, such as 2026-03-01 12:00:00.25, or a time of day, 12:00:00.25; else None."""
    for read in (datetime.fromisoformat, lambda x: datetime.combine(datetime.min, time.fromisoformat(x))):
        with suppress(ValueError):
            return read(text.strip())
    return None


def _numbers(where: Path, name: str, column: np.ndarray, complete: bool, first: int) -> np.ndarray:
    """A column as float64: finite numbers, and NaN unless the column has to be `complete`; rows count from `first`."""
    try:
        found = column.astype(np.float64)
    except (TypeError, ValueError):
        at = next(k for k in range(len(column)) if not _is_float(column[k : k + 1]))
        what = f"{where}, row {at + first}, column {quote(name)}: {quote(str(column[at]))} is not a number"
        raise InputError(f"{what}; convert it to numbers, or drop it") from None
    if column.dtype.kind in "iu" and column.size and max(abs(int(column.min())), abs(int(column.max()))) > EXACT:
        raise InputError(f"{where}, column {quote(name)}: integers above 2^53 would be rounded; subtract the first one")
    bad = np.nonzero(~np.isfinite(found) if complete else np.isinf(found))[0]
    if len(bad):
        at, value = bad[0] + first, found[bad[0]]
        raise InputError(f"{where}, row {at}, column {quote(name)}: {value} is not finite; drop that row")
    return found


def _is_float(cell: np.ndarray) -> bool:
    """Whether numpy converts a column of this single cell, such as None, to a float."""
    try:
        return cell.astype(np.float64).size == 1
    except (TypeError, ValueError):
        return False
