"""Trajectories as comma-separated text: `trajectory,t[s],q[rad],...`, one row a sample."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import datetime
from itertools import chain, islice
from pathlib import Path

import numpy as np

from herglotz.data.csv_columns import HEADER_DECIDES, Columns, Wanted, assign, is_number
from herglotz.data.csv_dialect import Rows, cells_of, in_commas
from herglotz.data.csv_numbers import NumberLines
from herglotz.data.files import PathLike, read_lines, write_atomically
from herglotz.data.rows import MISSING, number, number_or_none, quote
from herglotz.data.sensors import calibrated
from herglotz.data.table import from_table, in_dates, moment
from herglotz.data.trajectories import Trajectories
from herglotz.data.unit_row import refuse_unknown, with_units
from herglotz.errors import InputError, refuse

HEAD = 64  # lines that say how a table is written
SAID = r"#\s*(hold|delay|lag|zero|scale):\s*(.+)"  # what happens to inputs before they act, and what sensors read


def read_csv(path: PathLike, wanted: Wanted = HEADER_DECIDES) -> Trajectories:
    """Read trajectories from a csv file (UTF-8) whose columns have the wanted roles, and others by their names.

    `herglotz.data.load` asks for roles by keywords (`time=`, `coordinates=`, …) and for angles; here they are a
    `herglotz.data.csv_columns.Wanted`.

    Commas, semicolons, tabs or spaces stand between columns; where no commas do, decimals may have one. A coordinate
    that is empty or NaN has no weight in a fit (`Trajectories.observed`). A row without any, or without s or a
    momentum, is left out; the step over it has the mean of its inputs. An input that is empty is held from the row
    before, or goes in a straight line where its hold is "first" or "smooth".
    Rows of stacked tables are sorted by time, and those of one time joined.

    The header's cells are `name`, `name[unit]`, `name (unit)`, `name(unit)` of a known unit, or of angles and times
    `name_deg`, `t_ms`; it may stand behind #, as `numpy.savetxt` writes it, and the units in a row of their own below
    it. `t`, `time`, `timestamp`, `Zeit`, `temps`, `tiempo` or the only column in a unit of time is the time;
    `trajectory`, `trial` or `run`, if there, groups the rows; `s` is the action, `p`/`p_*` momenta. Of other columns an
    explicit unit decides before the name (`herglotz.data.column_roles`): rad, deg, m, mm, px are positions, N, Nm, A,
    V, % inputs, m/s, rad/s, rpm rates, which are left aside, and so are °C, Pa, W. What is wanted of a motion is an
    input in any unit: goal, target, set point, desired, reference, command, soll. Without a unit `u`, `u1`, `u_*`, `F`,
    force, torque, tau, voltage, motor are inputs; `v`, `vx`, velocity, `*_dot`, `dx`, `qd1` rates; errors,
    temperatures, batteries and counters (`index`, `frame`, a first column without a name) are left aside; every other
    column is a coordinate. A role that is a guess is said in a warning. A column may be named with its unit. Times may
    be dates in ISO 8601: they become seconds since the first row. Lines that start with # and blank lines are skipped,
    but for `# hold: zero` (or `first`, `smooth`), `# delay: 0.004` and `# lag: 0.02`, which say what the inputs do
    between samples and how late they act, in the file's unit of time, and `# zero: 0.02 -0.1` and `# scale: 1 0.5`,
    which make q = scale · (reading − zero) of the coordinates, one after the other (`herglotz.data.sensors`). A
    coordinate in rad is taken for an angle.

    Returns
    -------
    Trajectories
        In float64, as measured (`load` unwraps angles and converts degrees and milliseconds); `columns` holds the role
        of every column.

    Raises
    ------
    InputError
        Naming file, row (line of the file, from 1), column, value and remedy.
    """
    return _read_numbers(Path(path), wanted) or _read_rows(Path(path), wanted)


def _read_rows(path: Path, wanted: Wanted) -> Trajectories:
    """Row by row: dates, names of trajectories, and the place of every mistake."""
    lines = read_lines(path)
    columns, rows, notes, _ = _header(path, lines, wanted)
    _check_kinds(path, columns, rows)
    found = from_table(path, columns, *_parse_rows(path, columns, rows), lambda found: _held(found, lines))
    if not is_number(cells_of(rows[0][1])[columns.time]):
        found = in_dates(found)
    return replace(found, notes=(*notes, *found.notes))


def _header(path: Path, lines: Sequence[str], wanted: Wanted) -> tuple[Columns, Rows, tuple[str, ...], str]:
    """The columns of a table, its rows below the header and a row of units, notes on its text, and its separator."""
    rows, notes, separator = in_commas(path, lines)
    if not rows:
        raise InputError(f"{Path(path)}: there is no header; add a first line such as t[s],q[rad]")
    at, header = rows[0]
    cells, where = cells_of(header), f"{path}, row {at}"
    text = len(cells) == 1 and any(mark in line for _, line in rows[1:] for mark in ",;\t")
    refuse({f"{where}: {quote(header)} is no header; delete the lines above the table, or begin them with #": text})
    if len(rows) > 1 and (named := with_units(cells, cells_of(rows[1][1]), where, wanted)):
        cells, notes = named, (*notes, f"units stand in row {rows.pop(1)[0]}")
    return assign(cells, where, wanted), rows[1:], notes, separator


def _read_numbers(path: Path, wanted: Wanted) -> Trajectories | None:
    """A table whose columns of time, trajectories and motion are plain numbers; None for any other file.

    Its first lines say how it is written. Read row by row, a mistake has a place.
    """
    if not path.is_file():
        return None
    try:
        with open(path, encoding="utf-8-sig") as file, warnings.catch_warnings(action="ignore"):
            head = list(islice(file, HEAD))
            columns, rows, notes, separator = _header(path, [line.rstrip("\n") for line in head], wanted)
            first = rows[0][0]
            body = NumberLines(separator, len(columns.names), first)
            labelled = columns.trajectory is not None
            chosen = (*columns.numeric, *((columns.trajectory,) if columns.trajectory is not None else ()))
            table = body.parsed(chain(head[first - 1 :], file), chosen)
        labels = table[:, -1] if labelled else None
        if np.isnan(table[:, 0]).any() or (labels is not None and np.any(labels != np.round(labels))):
            return None
        said = [*(line for line in head[: first - 1] if line.startswith("#")), *body.comments]
        values = table[:, : len(columns.numeric)]
        found = from_table(path, columns, body.at, labels, values, lambda found: _held(found, said))
    except (OSError, ValueError, IndexError):
        return None
    return replace(found, notes=(*notes, *found.notes))


def _held(found: Trajectories, lines: Iterable[str]) -> Trajectories:
    """With what the first comments of each kind among the lines say of the inputs and of the sensors."""
    said: dict[str, str | float] = {}
    sensors: dict[str, list[float]] = {}
    for match in filter(None, (re.fullmatch(SAID, line.strip()) for line in lines)):
        name, text = match.groups()
        where = f"{found.source}, comment '# {name}: {text}'"
        if name in ("zero", "scale"):
            sensors.setdefault(name, [number(x, where) for x in text.replace(",", " ").split()])
        else:
            said.setdefault(name, text if name == "hold" else number(text, where))
    if found.hold:  # the user has said it
        said.pop("hold", None)
    return replace(calibrated(found, sensors.get("zero", ()), sensors.get("scale", ())), **said)  # type: ignore[arg-type]


def write_csv(path: PathLike, trajectories: Trajectories, *, comments: Sequence[str] = ()) -> None:
    """Write trajectories so that `read_csv` returns the same numbers, bit for bit, atomically.

    `comments` become lines that start with #. Positions that were not read are NaN. A coordinate in rad that is not an
    angle is written too, although `read_csv` reads it as an angle. Raise InputError if a coordinate's name or a unit
    cannot stand in the header (it has a comma, or means another column).
    """
    q = trajectories.names
    header = ["trajectory", f"t[{trajectories.time_unit}]"]
    header += [f"{name}[{unit}]" for name, unit in zip(q, trajectories.units, strict=True)]
    parts = [trajectories.t[:, None], trajectories.q]
    if trajectories.v is not None:  # left aside by `read_csv`, as all rates are
        rate = [f"{unit}/{trajectories.time_unit}".removesuffix("/1") for unit in trajectories.units]
        header += [f"{name}_dot[{unit}]" for name, unit in zip(q, rate, strict=True)]
        parts.append(trajectories.v)
    if trajectories.s is not None:
        header, parts = [*header, "s"], [*parts, trajectories.s[:, None]]
    if trajectories.p is not None:
        header, parts = header + [f"p_{name}" for name in q], [*parts, trajectories.p]
    if trajectories.u is not None:
        header, parts = header + [f"u_{i}" for i in range(trajectories.u.shape[1])], [*parts, trajectories.u]
    _check_header(Path(path), header, trajectories)
    table = np.concatenate([x.detach().cpu().numpy().astype(np.float64) for x in parts], axis=1)
    if trajectories.observed is not None:
        table[:, 1 : 1 + len(q)][trajectories.observed.cpu().numpy() == 0] = np.nan
    names = trajectories.trajectory.tolist()
    said = trajectories.arrival._asdict().items()
    comments = [*comments, *(f"{name}: {value}" for name, value in said if value not in ("", None))]
    lines = [f"# {line}" for text in comments for line in text.splitlines()] + [",".join(header)]
    lines += [",".join([str(b), *map(repr, row)]) for b, row in zip(names, table.tolist(), strict=True)]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _parse_rows(
    path: Path, columns: Columns, rows: Sequence[tuple[int, str]]
) -> tuple[list[int], list[str] | None, list[list[float]]]:
    """Return line number, trajectory label and numbers of every row; None for the labels where all are of one."""
    width, labels, values = len(columns.names), [], []
    first = None  # date of the first row, where times are dates
    parse = {i: number if i == columns.time else number_or_none for i in columns.numeric}
    for at, line in rows:
        cells = cells_of(line)
        if len(cells) != width:
            raise InputError(
                f"{path}, row {at}: {len(cells)} cells where the header has {width}; correct or delete the row"
            )
        date = moment(cells[columns.time]) if first is not None or not values else None
        if date is not None and not is_number(cells[columns.time]):
            first = first or date
            cells[columns.time] = repr(_since(first, date, f"{path}, row {at}"))
        values.append([parse[i](cells[i], f"{path}, row {at}, column '{columns.names[i]}'") for i in columns.numeric])
        labels.append("" if columns.trajectory is None else cells[columns.trajectory])
    if any(labels) and not all(labels):
        at = rows[labels.index("")][0]
        raise InputError(f"{path}, row {at}, column 'trajectory': blank, but other rows name a trajectory; fill it in")
    return [at for at, _ in rows], labels if any(labels) else None, values


def _check_kinds(path: Path, columns: Columns, rows: Sequence[tuple[int, str]]) -> None:
    """Raise where a column of text would be read as numbers: neither of its first two cells is one."""
    two = [cells for cells in (cells_of(line) for _, line in rows[:2]) if len(cells) == len(columns.names)]
    for i in columns.numeric if len(two) == 2 else ():
        if any(is_number(x) or x.casefold() in MISSING for x in (cells[i] for cells in two)):
            continue
        if i == columns.time and any(moment(cells[i]) for cells in two):
            continue
        name, remedy = columns.names[i], "write numbers, or dates such as 2026-03-01 12:00:00.25"
        if i != columns.time:
            remedy = f"leave the column out with --drop {name} (drop= in Python), or write numbers"
        raise InputError(f"{path}, row {rows[0][0]}, column '{name}': {quote(two[0][i])} is not a number; {remedy}")
    if len(two) == 2:
        refuse_unknown(columns, two[0], f"{path}, row {rows[0][0]}")


def _since(first: datetime, date: datetime, where: str) -> float:
    if (first.tzinfo is None) != (date.tzinfo is None):
        raise InputError(f"{where}: {date} and the first date {first} differ in having a time zone; write it in all")
    return (date - first).total_seconds()


def _check_header(path: Path, header: list[str], trajectories: Trajectories) -> None:
    """Raise unless `read_csv` would give every column of this header its present role."""
    line = ",".join(header)
    try:
        back = assign(cells_of(line), "header")
        same = [back.names[i] for i in back.q] == list(trajectories.names) and len(back.names) == len(header)
        units = tuple(back.units[i] for i in back.q) == trajectories.units
        clock = back.time == 1 and back.units[1] == trajectories.time_unit
    except InputError as error:
        raise InputError(f"{path}: the header {quote(line)} could not be read back ({error}); rename") from error
    if not (same and units and clock):
        raise InputError(
            f"{path}: coordinates {trajectories.names} in {trajectories.units} would not be read back from csv; "
            "rename those that mean another column (t, s, p, u, v, ...), or save as .npz"
        )
