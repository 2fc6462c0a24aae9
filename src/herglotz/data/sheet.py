"""A header and the rows below it, from a csv file or a DataFrame: units, roles of columns, groups of rows, numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, time
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from herglotz.data.checks import EXACT, MIN_SAMPLES, MISSING, number, numbers_runs, quote
from herglotz.data.column_roles import is_usual, kind_of, name_and_unit
from herglotz.data.csv_columns import HEADER_DECIDES, Columns, Wanted, as_names, assign, is_number, same_everywhere
from herglotz.data.rates import Recording, in_order
from herglotz.data.sensors import calibrated
from herglotz.data.table import from_table
from herglotz.data.trajectories import Trajectories
from herglotz.data.units import PER_SECOND, in_seconds
from herglotz.errors import InputError, refuse

# 3000 years: a time of so many counts is not in seconds.
MAX_SECONDS = 1e11
# Stamps in s since 1970 have ten digits from 2001 to 2286.
DATES = (1e9, 1e10)


@dataclass(frozen=True)
class Sheet:
    """A header and the rows below it.

    Parameters
    ----------
    path, where
        Begin messages about rows, and about the header.
    heads, first
        The header's cells; those of the row below, which may hold units.
    at
        Number of each row, for messages.
    column
        The cells of a column, by its number: an array (N,) of texts, numbers or dates.
    remedies
        For a cell that is no number, and for a number that is not finite.
    notes, settings
        On the text of the file; hold, delay, lag, zero and scale from its comments.
    """

    path: Path
    where: str
    heads: Sequence[str]
    first: Sequence[str]
    at: Sequence[int]
    column: Callable[[int], np.ndarray]
    remedies: tuple[str, str] = ("correct or delete the row", "correct or delete the row")
    notes: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)

    def cells(self, i: int) -> list[str]:
        """The cells of a column as text."""
        return list(map(str, self.column(i)))

    def is_text(self, i: int) -> bool:
        """Whether the first two cells of a column are texts, and neither numbers nor words for a missing value."""
        return len(self.at) > 1 and all(map(_is_text, self.column(i)[:2].tolist()))

    def is_constant(self, i: int) -> bool:
        """Whether a column has the same cell in every row."""
        return len(set(self.cells(i))) == 1

    def increases(self, i: int) -> bool:
        """Whether a column may be the time by its numbers, which rise twice at least for each fall to a new recording.

        Texts may be dates.
        """
        with suppress(TypeError, ValueError):
            steps = np.diff(self.column(i).astype(np.float64))
            rises, falls = int((steps > 0).sum()), int((steps < 0).sum())
            return rises > 0 and rises >= (MIN_SAMPLES - 1) * falls
        return True

    def numbers(self, columns: Columns) -> np.ndarray:
        """The numeric columns of all rows, (N, columns.numeric), NaN for a missing value; dates become seconds.

        Stamps above 2^53 count from the first stamp.
        """
        clock = less_first(seconds(self.column(columns.time), lambda k: f"{self.path}, row {self.at[k]}"))
        if len(self.at) > 1 and all(map(_is_text, clock[:2].tolist())):
            where = f"{self.path}, row {self.at[0]}, column '{columns.names[columns.time]}'"
            wrong = f"{quote(str(clock[0]))} is not a number; write numbers, or dates such as 2026-03-01 12:00:00.25"
            raise InputError(f"{where}: {wrong}")
        found = [self._numbers(columns.names[columns.time], clock, False)]
        found += [self._numbers(columns.names[i], self.column(i), True) for i in columns.numeric[1:]]
        return np.stack(found, 1)

    def _numbers(self, name: str, column: np.ndarray, may_miss: bool) -> np.ndarray:
        """A column as float64; cells may be missing, or else every cell is finite."""
        texts = column.dtype.kind in "OU"
        with suppress(TypeError, ValueError):
            found = (np.where(column == "", "nan", column) if texts else column).astype(np.float64)
            # NaN compares as False. Python reads 1_000 as a number.
            fine = (np.abs(found) < EXACT) | (np.isnan(found) & may_miss)
            if fine.all() and not (texts and "_" in "".join(map(str, column))):
                return found
        where = [f"{self.path}, row {row}, column '{name}'" for row in self.at]
        cells = zip(column.tolist(), where, strict=True)
        return np.array([np.nan if may_miss and _is_missing(x) else number(x, at, *self.remedies) for x, at in cells])


# Differences of numbers near the largest are infinite, and compare as such.
@np.errstate(over="ignore")
def from_sheet(sheet: Sheet, wanted: Wanted = HEADER_DECIDES) -> Trajectories:
    """The recordings of a sheet; see `herglotz.data.table.from_table`.

    Where no name says so and time starts anew, a column groups the rows by its values (`_group_by_values`), with a
    warning. A column that is the same in every row says nothing: text and unusual names without a unit are left aside,
    and a note says so. Raise InputError for any other column of text, and as
    `herglotz.data.csv_columns.assign` and `from_table`.
    """
    units: list[str] = []
    if named := with_units(sheet.heads, sheet.first, sheet.where, wanted):
        units = [f"units stand in row {sheet.at[0]}"]
        # The rows below.
        column = sheet.column
        sheet = replace(sheet, heads=named, at=sheet.at[1:], column=lambda i: column(i)[1:])
    hold = wanted.hold or sheet.settings.get("hold") or wanted.known_hold
    columns, values, notes = _grouped(sheet, replace(wanted, hold=hold))
    if since := _unit_since_1970(sheet, columns):
        columns = replace(columns, units=tuple(since if i == columns.time else x for i, x in enumerate(columns.units)))
    found = from_table(sheet.path, columns, sheet.at, _labels(sheet, columns, values), values)
    if since:
        found = _with_time_shown(found, f"taken for {since} since 1970")
    found = _with_settings(replace(found, notes=(*sheet.notes, *found.notes, *units, *notes)), sheet.settings)
    times = sheet.column(columns.time)
    if times.dtype.kind in "Mm" or (times.dtype.kind in "OU" and not is_number(str(times[0]))):
        # The table has durations, which have a unit, in the place of dates.
        return in_dates(found, "" if times.dtype.kind == "m" else "date")
    return found


def _grouped(sheet: Sheet, wanted: Wanted) -> tuple[Columns, np.ndarray, list[str]]:
    """The columns with the one that groups the rows, without those that say nothing; their numbers; and notes."""
    columns = assign(sheet.heads, sheet.where, wanted, sheet.is_constant, sheet.increases)
    wanted = wanted.by_name(sheet.heads, columns.names)
    texts = [i for i in columns.numeric if i != columns.time and sheet.is_text(i)]
    bare = columns.without(texts)
    _refuse_text(sheet, columns, [i for i in texts if not (bare.q and _is_free(columns, wanted, i))])
    values, notes = sheet.numbers(bare), []
    group = _group_by_values(sheet, bare, wanted, values) if columns.trajectory is None else columns.trajectory
    aside = _same_everywhere(sheet, bare, wanted, values, texts)
    _refuse_text(sheet, columns, [i for i in texts if i not in (group, *aside)])
    if not aside and group == columns.trajectory:
        return columns, values, notes
    if group is not None and group != columns.trajectory:
        notes = [
            f"warning: {columns.names[group]} is taken for the {'name' if sheet.is_text(group) else 'number'} of the "
            "recording, but by its values alone: it changes wherever time starts anew, and nowhere else; if another "
            "column numbers the recordings, give --group NAME (group= in Python)"
        ]
    names = [columns.names[i] for i in aside]
    groups = wanted.group if group is None else columns.names[group]
    drop = (*as_names(wanted.drop), *names)
    chosen = replace(wanted, time=columns.names[columns.time], drop=drop, group=groups)
    columns = assign(sheet.heads, sheet.where, chosen)
    values = values[:, [bare.numeric.index(i) for i in columns.numeric]]
    return columns, values, [*notes, *([same_everywhere(names)] if names else [])]


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
    # A unit, 1 as well, says that somebody meant the column.
    unusual = [i for i in columns.q if i in still and not (columns.units[i] or is_usual(columns.names[i], ""))]
    free = [i for i in unusual if _is_free(columns, wanted, i)]
    return [*filter(sheet.is_constant, texts), *(free if len(free) < len(columns.q) else [])]


def _labels(sheet: Sheet, columns: Columns, values: np.ndarray) -> list[str]:
    """The label of each row's recording, with a number if an earlier recording has the same: up, down, up (2).

    Raise if some rows have a label and others have not.
    """
    if columns.trajectory is None:
        return [""] * len(sheet.at)
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


def _with_settings(found: Trajectories, settings: Mapping[str, Any]) -> Trajectories:
    """The set with hold, delay, lag, zeros and scales of a file's comments; a hold that the user gives overrules."""
    found = calibrated(found, settings.get("zero", ()), settings.get("scale", ()))
    arrival = {name: settings[name] for name in ("hold", "delay", "lag") if name in settings}
    return replace(found, **arrival | ({"hold": found.hold} if found.hold else {}))


def in_dates(found: Trajectories, unit: str = "date") -> Trajectories:
    """The set with its times in s, as dates and durations are whatever the header says; `unit` joins the table."""
    return replace(in_seconds(_with_time_shown(found, unit)), t=found.t, time_unit="s")


def _with_time_shown(found: Trajectories, unit: str) -> Trajectories:
    """The set whose table of columns has this unit for the time, unless it is ""."""
    roles = ((name, role, (unit or own) if role == "time" else own) for name, role, own in found.columns)
    return replace(found, columns=tuple(roles))


def with_units(cells: Sequence[str], below: Sequence[str], where: str, wanted: Wanted) -> list[str] | None:
    """The header's cells as `name[unit]` with the units of the row below; None if that row holds no units.

    The row holds units if no cell is a number, and the cell of the time is a unit of time; 1 and a dash stand for no
    unit. Raise InputError, which begins with `where` (file and row), if a name has different units in the header and
    below, or as `herglotz.data.csv_columns.assign`.
    """
    units = [cell.strip("[]()<> ").removesuffix("-") for cell in below]
    samples = any(is_number(unit) and unit != "1" for unit in units)
    if len(units) != len(cells) or not {"s", *PER_SECOND}.intersection(units) or samples:
        return None
    own = [(name_and_unit(cell) or ("", ""))[1] for cell in cells]
    named = list(zip(cells, units, own, strict=True))
    both = [f"{cell!r} and below it {unit!r}" for cell, unit, head in named if head and unit not in ("", head)]
    refuse({f"{where}: two units of one column, {both and both[0]}; keep one of them": both})
    found = [f"{cell}[{unit}]" if unit and not head else cell for cell, unit, head in named]
    clock = assign(found, where, wanted).time
    return found if units[clock] in ("s", *PER_SECOND) else None


def from_frame(frame: Any, wanted: Wanted = HEADER_DECIDES, where: Path = Path("DataFrame")) -> Trajectories:
    """Read a pandas DataFrame (or anything with `columns` and `frame[name]`) like a csv file with that header.

    `where` begins messages. The index of a DataFrame joins the columns, unless the index merely counts the rows.
    InputError names column, row (counted from 0), value and remedy.
    """
    frame = _with_index(frame)
    raw = [plain(frame[name], f"{where}, column {quote(str(name))}: numbers") for name in frame.columns]
    rows = _two_rows(list(frame.columns))
    heads = (rows and with_units(*rows, str(where), wanted)) or [str(name) for name in frame.columns]
    # A number of any size stands for no unit.
    first = [
        x if isinstance(x, str) else "" if _is_missing(x) else "0"
        for x in (own[0] for own in raw if own.ndim == 1 and len(own))
    ]
    remedies = "convert it to numbers, or drop it", "drop that row"
    return from_sheet(
        Sheet(where, str(where), heads, first, range(len(raw[0]) if raw else 0), raw.__getitem__, remedies), wanted
    )


def _two_rows(names: Sequence[Any]) -> tuple[list[str], list[str]] | None:
    """Names and units of a header of two rows, which pandas holds as pairs; None for any other header."""
    if not all(isinstance(name, tuple) and len(name) == 2 for name in names):
        return None
    units = [str(unit) for _, unit in names]
    return [str(name) for name, _ in names], ["" if x.startswith("Unnamed: ") else x for x in units]


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


def seconds(column: np.ndarray, place: Callable[[int], str]) -> np.ndarray:
    """Times in seconds: of dates since the first date, of durations their length; other cells and columns unchanged.

    Raise InputError, which names the `place` of a row, if some dates have a time zone and others have none.
    """
    if column.dtype.kind in "Mm":
        return (column - column[:1] if column.dtype.kind == "M" else column) / np.timedelta64(1, "s")
    if column.dtype.kind not in "OU" or not len(column) or not (first := _date(column[0])):
        return column
    found = column.astype(object)
    for k, date in enumerate(map(_date, column)):
        if date is not None and (date.tzinfo is None) != (first.tzinfo is None):
            what = f"times are not all with a time zone: {date} and the first date {first} differ in having a time zone"
            raise InputError(f"{place(k)}: {what}; write it in all")
        found[k] = column[k] if date is None else (date - first).total_seconds()
    return found


def less_first(column: np.ndarray) -> np.ndarray:
    """Stamps above 2^53, of which float64 would lose digits, less the first; other cells and columns unchanged."""
    first = _decimal(column[0]) if len(column) else None
    if first is None or abs(first) < EXACT:
        return column
    found = column.astype(object)
    found[:] = [x if (stamp := _decimal(x)) is None else stamp - first for x in column.tolist()]
    return found


def _decimal(x: Any) -> Decimal | None:
    """The finite number in a cell, with all its digits; None for any other cell."""
    with suppress(InvalidOperation):
        found = Decimal(text) if "_" not in (text := str(x)) else None
        return found if found is not None and found.is_finite() else None


def _unit_since_1970(sheet: Sheet, columns: Columns) -> str:
    """The unit of stamps without a unit that count from 1970: ms, us or ns; "" for any other time.

    Raise InputError for a time without a unit that is far too large for seconds, and is no such stamp.
    """
    last = next(filter(None, map(_decimal, sheet.column(columns.time)[-1:])), None)
    if last is None or last <= MAX_SECONDS or columns.units[columns.time]:
        return ""
    for unit in ("ms", "us", "ns"):
        if DATES[0] <= float(last) / PER_SECOND[unit] < DATES[1]:
            return unit
    name = columns.names[columns.time]
    what = f"{name} of {float(last):.4g} without a unit is no time in s"
    raise InputError(f"{sheet.path}: {what}; write its unit, {name}[ms], {name}[us] or {name}[ns]")


def _date(x: Any) -> datetime | None:
    """A date, or a date or time of day in ISO 8601, such as 2026-03-01 12:00:00.25 or 12:00:00.25; else None."""
    if isinstance(x, datetime):
        return x
    for read in (datetime.fromisoformat, lambda text: datetime.combine(datetime.min, time.fromisoformat(text))):
        with suppress(ValueError):
            return None if not isinstance(x, str) or is_number(x) else read(x.strip())
    return None


def _with_index(frame: Any) -> Any:
    """A DataFrame with its index as columns: a named index by its name, unnamed dates or floats as the time."""
    index = getattr(frame, "index", None)
    if index is None or not hasattr(frame, "reset_index"):
        return frame
    if any(name is not None for name in index.names):
        return frame.reset_index()
    is_clock = index.dtype.kind in "Mmf" and not {"t", "time"} & set(map(str, frame.columns))
    return frame.rename_axis("time").reset_index() if is_clock else frame


def _is_missing(x: Any) -> bool:
    """Whether a cell holds no value."""
    return x is None or x != x or (isinstance(x, str) and x.casefold() in MISSING)


def _is_text(x: Any) -> bool:
    """Whether a cell is a text, and neither a number nor a word for a missing value."""
    return isinstance(x, str) and not is_number(x) and not _is_missing(x)
