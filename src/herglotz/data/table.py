"""`Trajectories` from the columns of a table: a csv file or a DataFrame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from herglotz.data.checks import MIN_SAMPLES, Unusable, begins_anew, numbering, out_of_order, quote
from herglotz.data.csv_columns import Columns
from herglotz.data.gaps import with_missing
from herglotz.data.marks import without_marks
from herglotz.data.rates import Recording, completed, in_order, without_repeats
from herglotz.data.trajectories import Trajectories
from herglotz.errors import refuse

Item = TypeVar("Item")
Read = TypeVar("Read")
# Rows at which a clock falls back that the warning names.
MAX_ROWS = 4


def from_table(
    path: Path,
    columns: Columns,
    at: Sequence[int],  # (N,) row number of each sample in the file, for messages
    labels: Sequence[str],  # (N,) trajectory of each sample
    values: Any,  # (N, columns.numeric) numbers; NaN where a coordinate, s, a momentum or an input is missing
) -> Trajectories:
    """Group the rows into trajectories; a coordinate in rad is taken for an angle.

    A row in which some coordinates are missing keeps the others (`herglotz.data.gaps`). Rows without any coordinate
    are left out, and a note gives their number: the step over these rows is longer, with the mean of the inputs
    (`herglotz.data.rates`). Marks of missing readings are missing, with a warning (`herglotz.data.marks`). A clock
    that falls back begins another trajectory, with a warning. A trajectory that is too short, or whose time does not
    increase, is left out with a warning. Raise InputError, which begins with `path`, if most trajectories are
    unusable.
    """
    values = np.asarray(values, dtype=np.float64).reshape(len(at), len(columns.numeric))
    marked = [
        (k, columns.names[i], i in columns.u) for k, i in enumerate(columns.numeric) if i in (*columns.q, *columns.u)
    ]
    values, marks = without_marks(values, labels, at, marked)
    columns, values = _without_blank(columns, values)
    recordings = _recordings(path, labels, np.asarray(at), values)
    recordings, repairs = _with_clocks(recordings, bool(np.isnan(values).any()), columns)
    recordings, unordered = usable(path, recordings, lambda one: _in_time(path, columns, one))
    recordings, filled, hold = completed(recordings, columns, columns.hold)
    recordings, too_few = usable(path, recordings, lambda one: _with_enough(path, columns, one))
    found = _trajectories(path, columns, recordings, hold)
    found = replace(found, notes=(*columns.notes, *marks, *repairs, *unordered, *filled, *too_few))
    return _with_missing(found, columns, recordings)


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


def _with_clocks(recordings: list[Recording], blank: bool, columns: Columns) -> tuple[list[Recording], list[str]]:
    """The recordings sorted by time, cut where their clock falls back, and without repeated stamps; with notes.

    Only rows with blank cells may be stacked tables, whose rows have to be sorted. A note on the first repaired stamps
    counts the other recordings with such stamps.
    """
    ordered = [in_order(one) if blank else one for one in recordings]
    parts = [_parts(one) for one in ordered]
    made = [without_repeats(part, columns) for own in parts for part in own]
    notes = [note for _, note in made if note]
    more = f", and so of {len(notes) - 1} more recordings" if len(notes) > 1 else ""
    cuts = [part.at[0] for own in parts for part in own[1:]]
    return [one for one, _ in made], [*_note_of_cuts(ordered, cuts, columns), *(f"{x}{more}" for x in notes[:1])]


def _parts(one: Recording) -> list[Recording]:
    """The recordings that begin where the clock falls back; the rows as they are if some falls begin none."""
    ends = [*(np.flatnonzero(np.diff(one.values[:, 0]) < 0) + 1).tolist(), len(one.at)]
    runs = [slice(first, last) for first, last in pairwise([0, *ends])]
    if not all(begins_anew(one.values[a, 0], one.values[b, 0]) for a, b in pairwise(runs)) or len(runs) < 2:
        return [one]
    names = [f"{one.label} ({k + 1})" if k else one.label for k in range(len(runs))]
    if not one.label:
        names = [f"rows {one.at[run][0]} to {one.at[run][-1]}" for run in runs]
    return [Recording(name, one.at[run], one.values[run]) for name, run in zip(names, runs, strict=True)]


def _note_of_cuts(recordings: Sequence[Recording], cuts: Sequence[int], columns: Columns) -> list[str]:
    """The warning of clocks that fall back at these rows, with the column that numbers the recordings, if one does."""
    if not cuts:
        return []
    rows = [*map(str, cuts[:MAX_ROWS]), *([f"{len(cuts) - MAX_ROWS} more"] if len(cuts) > MAX_ROWS else [])]
    values = np.concatenate([one.values for one in recordings])
    numbered = numbering(values, np.diff(values[:, 0]) < 0, [columns.names[i] for i in columns.numeric])
    remedy = numbered or "a column that numbers the recordings is given by --group NAME (group= in Python)"
    where = f"row {rows[0]}, and a new recording begins" if len(cuts) == 1 else (
        f"rows {', '.join(rows)}, and a new recording begins at each"
    )  # fmt: skip
    clock = columns.names[columns.time]
    return [f"warning: {clock} falls back at {where}; if it is one recording, sort the rows; {remedy}"]


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
    t, clock = one.values[:, 0], columns.names[columns.time]
    if len(t) < MIN_SAMPLES:
        has = f"has {len(t)} sample{'s' if len(t) > 1 else ''}, at least {MIN_SAMPLES} are needed"
        where = f"{path}, row {one.at[0]}"
        if columns.trajectory is not None and one.label:
            label = columns.names[columns.trajectory]
            raise Unusable(f"{where}, column '{label}': {quote(one.label)} {has}; delete it or add rows")
        raise Unusable(f"{where}: the file {has}; add rows")
    d = np.diff(t)
    # `without_repeats` mends repeated stamps wherever no stamp decreases.
    back = d < 0 if (d < 0).any() else ~(d > 0)
    if back.any():
        k = int(back.argmax())
        names = [columns.names[i] for i in columns.numeric]
        raise Unusable(
            f"{path}, row {one.at[k + 1]}, column '{clock}': {float(t[k + 1])!r} does not increase on {float(t[k])!r} "
            f"in row {one.at[k]}; {out_of_order(one.values, back, names)}"
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


def _trajectories(path: Path, columns: Columns, recordings: Sequence[Recording], hold: str) -> Trajectories:
    """The set of these recordings, a sample a row, with 0 for a missing value, and this hold of inputs."""
    table = np.nan_to_num(np.concatenate([one.values for one in recordings]))
    lengths = tuple(len(one.values) for one in recordings)
    widths = [1, len(columns.q), 0 if columns.s is None else 1, len(columns.p), len(columns.u)]
    t, q, s, p, u = np.split(table, np.cumsum(widths)[:-1], axis=1)
    units = tuple(columns.units[i] or "1" for i in columns.q)
    group = "" if columns.trajectory is None else columns.names[columns.trajectory]
    labels = [one.label for one in recordings]
    return Trajectories.of(
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
        hold=hold if columns.u else "",
        source=path.name,
        columns=columns.roles(),
        recordings=[f"{group} {one.label}".lstrip() for one in recordings] if any(labels) else (),
    )
