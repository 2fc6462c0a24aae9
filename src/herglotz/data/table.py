"""`Trajectories` from the columns of a table: a csv file or a DataFrame."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime, time
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from herglotz.data.checks import EXACT, MIN_SAMPLES, MISSING, Unusable, numbers_runs, out_of_order, quote
from herglotz.data.column_roles import is_usual, kind_of
from herglotz.data.csv_columns import HEADER_DECIDES, Columns, Wanted, as_names, assign, is_number, same_everywhere
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


@dataclass(frozen=True)
class Sheet:
    """A header and the rows below it, as a file or a DataFrame holds them.

    `where` names the header in messages. Of a column, by its number, `cells` are the cells as text, and `is_text` says
    whether they are no numbers. `numbers` are the numeric columns, (N, columns.numeric), NaN for a missing value.
    """

    path: Path
    where: str
    heads: Sequence[str]
    at: Sequence[int]  # (N,) number of each row, for messages
    cells: Callable[[int], list[str]]
    is_text: Callable[[int], bool]
    numbers: Callable[[Columns], np.ndarray]

    def is_constant(self, i: int) -> bool:
        """Whether a column has the same cell in every row."""
        return len(set(self.cells(i))) == 1


def from_sheet(
    sheet: Sheet, wanted: Wanted, with_settings: Callable[[Trajectories], Trajectories] = lambda found: found
) -> Trajectories:
    """The recordings of a sheet; see `from_table`.

    Where no name says so and time starts anew, a column groups the rows by its values (`_group_by_values`), with a
    warning. Beside a column that groups the rows, one that is the same in every row says nothing: text and unusual
    names without a unit are left aside, and a note says so. Raise InputError for any other column of text, and as
    `herglotz.data.csv_columns.assign` and `from_table`.
    """
    columns = assign(sheet.heads, sheet.where, wanted, sheet.is_constant)
    wanted = wanted.by_name(sheet.heads, columns.names)
    texts = [i for i in columns.numeric if i != columns.time and sheet.is_text(i)]
    bare = columns.without(texts)
    _refuse_text(sheet, columns, [i for i in texts if not (bare.q and _is_free(columns, wanted, i))])
    values = sheet.numbers(bare)
    group, notes = columns.trajectory, []
    if group is None and (group := _group_by_values(sheet, bare, wanted, values)) is not None:
        kind = "name" if sheet.is_text(group) else "number"
        notes = [
            f"warning: {columns.names[group]} is taken for the {kind} of the recording, but by its values alone: it "
            "changes wherever time starts anew, and nowhere else; if another column numbers the recordings, give "
            "--group NAME (group= in Python)"
        ]
    aside = [] if group is None else _same_everywhere(sheet, bare, wanted, values, texts)
    _refuse_text(sheet, columns, [i for i in texts if i not in (group, *aside)])
    if group is None:
        return from_table(sheet.path, columns, sheet.at, [""] * len(values), values, with_settings)
    if aside or notes:
        names = [columns.names[i] for i in aside]
        chosen = replace(wanted, drop=(*as_names(wanted.drop), *names), group=columns.names[group])
        columns = assign(sheet.heads, sheet.where, chosen)
        values = values[:, [bare.numeric.index(i) for i in columns.numeric]]
        notes += [same_everywhere(names)] if names else []
    found = from_table(sheet.path, columns, sheet.at, _labels(sheet, columns, values), values, with_settings)
    return replace(found, notes=(*found.notes, *notes))


def _is_free(columns: Columns, wanted: Wanted, i: int) -> bool:
    """Whether a column may group the rows: it is no position by its unit, and nobody has given it another role."""
    name, fixed = columns.names[i], i in (columns.time, columns.s, *columns.p)
    told = wanted.role(name) is not None or wanted.before(name) not in (None, "dropped")
    return not (fixed or told or kind_of(columns.units[i]) == "position")


def _refuse_text(sheet: Sheet, columns: Columns, texts: Sequence[int]) -> None:
    """Raise if there is a column of text that would be read as numbers."""
    for i in texts:
        name, where = columns.names[i], f"{sheet.path}, row {sheet.at[0]}"
        raise InputError(
            f"{where}, column '{name}': {quote(sheet.cells(i)[0])} is not a number; write numbers, leave the column "
            f"out with --drop {name} (drop= in Python), or group the rows by it with --group {name} (group= in Python)"
        )


def _group_by_values(sheet: Sheet, columns: Columns, wanted: Wanted, values: np.ndarray) -> int | None:
    """The column whose values change wherever time starts anew, and nowhere else; None for no column.

    Numbers differ from recording to recording, texts may come again. A position groups no rows, and neither does an
    input: a constant input is one. Rows of stacked tables, which are sorted by time, are one recording.
    """
    anew = np.diff(values[:, 0]) < 0
    if not anew.any():
        return None
    if not (np.diff(in_order(Recording("", np.arange(len(values)), values)).values[:, 0]) < 0).any():
        return None
    free = [i for i in range(len(columns.names)) if i not in columns.u and _is_free(columns, wanted, i)]
    for i in sorted(free, key=lambda i: i not in columns.q):
        if (columns.q != (i,)) and numbers_runs(np.array(sheet.cells(i)), anew, again=sheet.is_text(i)):
            return i
    return None


def _same_everywhere(
    sheet: Sheet, columns: Columns, wanted: Wanted, values: np.ndarray, texts: Sequence[int]
) -> list[int]:
    """Columns of text, and coordinates without a unit and a usual name, that are the same in every row."""
    still = [columns.numeric[k] for k in np.flatnonzero((values == values[:1]).all(0))]
    unusual = [i for i in columns.q if i in still and not is_usual(columns.names[i], columns.units[i])]
    free = [i for i in unusual if _is_free(columns, wanted, i)]
    return [*filter(sheet.is_constant, texts), *(free if len(free) < len(columns.q) else [])]


def _labels(sheet: Sheet, columns: Columns, values: np.ndarray) -> list[str]:
    """The label of each row's recording, with a number if an earlier recording has the same: up, down, up (2).

    Raise if some rows have a label and others have not.
    """
    assert columns.trajectory is not None
    labels = sheet.cells(columns.trajectory)
    if any(labels) and not all(labels):
        where = f"{sheet.path}, row {sheet.at[labels.index('')]}, column 'trajectory'"
        raise InputError(f"{where}: blank, but other rows name a trajectory; fill it in")
    anew = np.diff(values[:, 0]) < 0
    if not len(labels) or not numbers_runs(np.array(labels), anew, again=True):
        return labels
    found: list[str] = []
    seen: Counter[str] = Counter()
    for label, begins in zip(labels, [True, *anew.tolist()], strict=True):
        seen[label] += begins
        found.append(label if seen[label] == 1 else f"{label} ({seen[label]})")
    return found


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
    raw = [column[first:] for column in raw]
    clock = assign(heads, str(where), wanted).time
    times, raw[clock] = raw[clock], seconds(raw[clock])
    rows = range(first, first + len(times))

    def is_text(i: int) -> bool:
        pair = raw[i][:2].tolist() if raw[i].dtype.kind in "OU" else []
        return len(pair) == 2 and all(isinstance(x, str) and is_text_cell(x) for x in pair)

    def numbers(columns: Columns) -> np.ndarray:
        every = [_numbers(where, columns.names[i], raw[i], i == columns.time, first) for i in columns.numeric]
        return np.stack(every, 1)

    found = from_sheet(
        Sheet(where, str(where), heads, rows, lambda i: list(map(str, raw[i])), is_text, numbers), wanted
    )
    if raw[clock] is times:
        return found
    return in_dates(found, "" if times.dtype.kind == "m" else "date")


def is_text_cell(cell: str) -> bool:
    """Whether a cell is neither a number nor a word for a missing value."""
    return not is_number(cell) and cell.casefold() not in MISSING


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
