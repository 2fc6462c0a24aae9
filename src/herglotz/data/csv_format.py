"""Trajectories as comma-separated text: `trajectory,t[s],q[rad],...`, a row for each sample."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch

from herglotz.data.checks import EXACT
from herglotz.data.csv_columns import HEADER_DECIDES, Columns, Wanted, assign, is_number
from herglotz.data.csv_dialect import Rows, cells_of, in_commas
from herglotz.data.files import PathLike, read_lines, write_atomically
from herglotz.data.rows import MISSING, number, quote
from herglotz.data.sensors import calibrated
from herglotz.data.table import from_table, in_dates, moment, with_units
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError, refuse

# Comments about inputs (hold, delay, lag) and about sensors (zero, scale).
SETTING = re.compile(r"#\s*(hold|delay|lag|zero|scale):\s*(.+)")


def read_csv(path: PathLike, wanted: Wanted = HEADER_DECIDES) -> Trajectories:
    """Read trajectories from a csv file; `wanted` gives columns their roles, and names and units decide the others.

    `herglotz.data.load` takes the roles as keywords (`time=`, `coordinates=`, …), and angles; here the roles are a
    `herglotz.data.csv_columns.Wanted`.

    **Text.** UTF-8. Commas, semicolons, tabs or spaces separate columns; unless commas do, decimals may have a comma.
    The header's cells are `name`, `name[unit]`, `name (unit)`, or with a known unit `name(unit)`, `name_unit` as in
    `tip_um`, `speed_rpm`, `v_m_s`, or `angleDeg` (`herglotz.data.header_cells` says where the end of a name is an
    index). The header may stand behind #, as `numpy.savetxt` writes headers, and units may stand in a row
    of their own below the header. Other lines that start with # and blank lines are skipped, except for these comments:
    `# hold: zero` (or `first`, `smooth`) is the hold of the inputs between samples, `# delay: 0.004` and `# lag: 0.02`
    are their delay and lag in the file's unit of time, and `# zero: 0.02 -0.1` and `# scale: 1 0.5` make
    q = scale · (reading − zero) of the coordinates in order (`herglotz.data.sensors`).

    **Roles.** `t`, `time`, `timestamp`, `Zeit`, `temps`, `tiempo` or the only column in a unit of time is the time.
    Times may be dates in ISO 8601, which become seconds since the first row. `trajectory`, `trial` or `run` groups the
    rows; `s` is the action, `p`/`p_*` are momenta. Of other columns the unit decides before the name
    (`herglotz.data.column_roles`): rad, deg, m, mm, px are positions; N, Nm, A, V, % inputs; m/s, rad/s, rpm rates;
    rates are left aside, and so are °C, Pa, W. A set value of a motion is an input in any unit: goal, target, set
    point, desired, reference, command, soll. Without a unit `u`, `u1`, `u_*`, `F`, force, torque, tau, voltage, motor
    are inputs; `v`, `vx`, velocity, `*_dot`, `dx`, `qd1` rates; errors, temperatures, batteries and counters (`index`,
    `frame`, a first column without a name) are left aside; every other column is a coordinate. A coordinate in rad is
    taken for an angle. A warning names every role that is a guess.

    **Missing values.** A coordinate that is empty or NaN has no weight in a fit (`Trajectories.observed`). A row
    without any coordinate, or without s or a momentum, is left out; the step over that row has the mean of the inputs.
    An empty input is held from the row before, or interpolated linearly if the hold is "first" or "smooth". Rows of
    stacked tables are sorted by time, and rows of equal time joined.

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
    path = Path(path)
    lines = read_lines(path)
    columns, rows, notes = _header(path, lines, wanted)
    _check_kinds(path, columns, rows)
    comments = [line for line in lines if line.lstrip().startswith("#")]
    values = _plain_numbers(columns, rows)
    values = _parse_rows(path, columns, rows) if values is None else values
    labels, at = _labels(path, columns, rows), [i for i, _ in rows]
    found = from_table(path, columns, at, labels, values, lambda found: _with_settings(found, comments))
    if rows and not is_number(cells_of(rows[0][1])[columns.time]):
        found = in_dates(found)
    return replace(found, notes=(*notes, *found.notes))


def _header(path: Path, lines: Sequence[str], wanted: Wanted) -> tuple[Columns, Rows, tuple[str, ...]]:
    """The columns of a table, its rows below the header and a row of units, and notes on its text."""
    rows, notes = in_commas(path, lines)
    if not rows:
        raise InputError(f"{path}: there is no header; add a first line such as t[s],q[rad]")
    at, header = rows[0]
    cells, where = cells_of(header), f"{path}, row {at}"
    is_title = len(cells) == 1 and any(mark in line for _, line in rows[1:] for mark in ",;\t")
    refuse({f"{where}: {quote(header)} is no header; delete the lines above the table, or begin them with #": is_title})
    if len(rows) > 1 and (named := with_units(cells, cells_of(rows[1][1]), where, wanted)):
        cells, notes = named, (*notes, f"units stand in row {rows.pop(1)[0]}")
    return assign(cells, where, wanted), rows[1:], notes


def _plain_numbers(columns: Columns, rows: Rows) -> np.ndarray | None:
    """The numeric columns of all rows, (N, k), NaN in empty cells; None for a table with any other cell.

    numpy's parser takes a fifth of the time of `_parse_rows`, which names the row of a mistake.
    """
    width = len(columns.names)
    if not rows or any(line.count(",") + 1 != width for _, line in rows):
        return None
    lines = (_with_nan(line) for _, line in rows)
    try:
        table = np.loadtxt(lines, delimiter=",", comments=None, ndmin=2, usecols=columns.numeric)
    except ValueError:
        return None
    # NaN compares as False, and so does a time that is missing.
    exact = (np.abs(table) < EXACT) | np.isnan(table)
    return table if exact.all() and not np.isnan(table[:, 0]).any() else None


def _with_nan(line: str) -> str:
    """The row with "nan" in its empty cells."""
    if ",," in line or line[0] == "," or line[-1] == ",":
        return ",".join(cell or "nan" for cell in line.split(","))
    return line


def _labels(path: Path, columns: Columns, rows: Rows) -> list[str]:
    """The label of the trajectory of each row; raise if some rows have a label and others have not."""
    if columns.trajectory is None:
        return [""] * len(rows)
    labels = [cells_of(line)[columns.trajectory] for _, line in rows]
    if any(labels) and not all(labels):
        where = f"{path}, row {rows[labels.index('')][0]}, column 'trajectory'"
        raise InputError(f"{where}: blank, but other rows name a trajectory; fill it in")
    return labels


def _parse_rows(path: Path, columns: Columns, rows: Rows) -> list[list[float]]:
    """The numbers of every row, cell by cell: dates become seconds, and an error names row and column."""
    width, values = len(columns.names), []
    # The date of the first row, where times are dates.
    first = None
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
        missing = {i for i in columns.numeric if i != columns.time and cells[i].casefold() in MISSING}
        where = {i: f"{path}, row {at}, column '{columns.names[i]}'" for i in columns.numeric}
        values.append([math.nan if i in missing else number(cells[i], where[i]) for i in columns.numeric])
    return values


def _check_kinds(path: Path, columns: Columns, rows: Rows) -> None:
    """Raise if a column of text would be read as numbers: neither of its first two cells is a number."""
    two = [cells for cells in (cells_of(line) for _, line in rows[:2]) if len(cells) == len(columns.names)]
    for i in columns.numeric if len(two) == 2 else ():
        name, pair = columns.names[i], [cells[i] for cells in two]
        remedy = f"leave the column out with --drop {name} (drop= in Python), or write numbers"
        is_date = i == columns.time and any(map(moment, pair))
        if i == columns.time:
            remedy = "write numbers, or dates such as 2026-03-01 12:00:00.25"
        if not is_date and not any(is_number(x) or x.casefold() in MISSING for x in pair):
            raise InputError(f"{path}, row {rows[0][0]}, column '{name}': {quote(pair[0])} is not a number; {remedy}")


def _since(first: datetime, date: datetime, where: str) -> float:
    """Seconds from the first date to this date."""
    if (first.tzinfo is None) != (date.tzinfo is None):
        raise InputError(f"{where}: {date} and the first date {first} differ in having a time zone; write it in all")
    return (date - first).total_seconds()


def _with_settings(found: Trajectories, comments: Iterable[str]) -> Trajectories:
    """The set with hold, delay, lag, zeros and scales from the first comment of each kind."""
    arrival: dict[str, Any] = {}
    sensors: dict[str, list[float]] = {}
    for match in filter(None, (SETTING.fullmatch(line.strip()) for line in comments)):
        name, text = match.groups()
        where = f"{found.source}, comment '# {name}: {text}'"
        if name in ("zero", "scale"):
            sensors.setdefault(name, [number(x, where) for x in text.replace(",", " ").split()])
        else:
            arrival.setdefault(name, text if name == "hold" else number(text, where))
    # The user's hold overrules the file's.
    arrival |= {"hold": found.hold} if found.hold else {}
    return replace(calibrated(found, sensors.get("zero", ()), sensors.get("scale", ())), **arrival)


def write_csv(path: PathLike, trajectories: Trajectories, *, comments: Sequence[str] = ()) -> None:
    """Write trajectories so that `read_csv` returns the same numbers, bit for bit, atomically.

    `comments` become lines that start with #. Positions that were not read are NaN. A coordinate in rad that is not an
    angle is written too, although `read_csv` reads it as an angle. Raise InputError if a coordinate's name or a unit
    cannot stand in the header, because of a comma or because the name means another column.
    """
    header, table = _table(trajectories)
    _check_header(Path(path), header, trajectories)
    names = trajectories.trajectory.tolist()
    arrival = trajectories.arrival._asdict().items()
    comments = [*comments, *(f"{name}: {value}" for name, value in arrival if value not in ("", None))]
    lines = [f"# {line}" for text in comments for line in text.splitlines()] + [",".join(header)]
    lines += [",".join([str(b), *map(repr, row)]) for b, row in zip(names, table.tolist(), strict=True)]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _table(data: Trajectories) -> tuple[list[str], np.ndarray]:
    """The header's cells, and the numbers below all cells but the first, which is the trajectory's."""
    q = data.q if data.observed is None else data.q.where(data.observed > 0, torch.nan)
    rates = [f"{unit}/{data.time_unit}".removesuffix("/1") for unit in data.units]
    blocks = [
        ([f"t[{data.time_unit}]"], data.t),
        ([f"{name}[{unit}]" for name, unit in zip(data.names, data.units, strict=True)], q),
        # `read_csv` leaves all rates aside.
        ([f"{name}_dot[{unit}]" for name, unit in zip(data.names, rates, strict=True)], data.v),
        (["s"], data.s),
        ([f"p_{name}" for name in data.names], data.p),
        ([f"u_{i}" for i in range(0 if data.u is None else data.u.shape[1])], data.u),
    ]
    header = ["trajectory", *(name for names, x in blocks if x is not None for name in names)]
    parts = [x.detach().cpu().double().reshape(data.samples, -1) for _, x in blocks if x is not None]
    return header, torch.cat(parts, 1).numpy()


def _check_header(path: Path, header: list[str], trajectories: Trajectories) -> None:
    """Raise unless `read_csv` would give every column of this header its present role."""
    line = ",".join(header)
    try:
        back = assign(cells_of(line), "header")
    except InputError as error:
        raise InputError(f"{path}: the header {quote(line)} could not be read back ({error}); rename") from error
    names, units = ([labels[i] for i in back.q] for labels in (back.names, back.units))
    found = (tuple(names), tuple(units), len(back.names), back.time, back.units[back.time])
    if found != (trajectories.names, trajectories.units, len(header), 1, trajectories.time_unit):
        raise InputError(
            f"{path}: coordinates {trajectories.names} in {trajectories.units} would not be read back from csv; "
            "rename those that mean another column (t, s, p, u, v, ...), or save as .npz"
        )
