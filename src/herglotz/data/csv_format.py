"""Trajectories as comma-separated text, `trajectory,t[s],q[rad],...`, also as spreadsheets and loggers write such text.

The tables of spreadsheets, loggers and `numpy.savetxt` have other separators, decimal commas, or a header behind #:
their rows are first written with commas between columns, with decimal points, and with exponents behind E.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from herglotz.data.checks import MISSING, number, quote
from herglotz.data.column_roles import is_time, kind_of, name_and_unit
from herglotz.data.csv_columns import HEADER_DECIDES, Wanted, assign, is_number
from herglotz.data.files import PathLike, read_lines, write_atomically
from herglotz.data.sheet import Sheet, from_sheet
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError, refuse

# Separators in the order of trial; the comma stands last but one, because a comma may be a decimal sign.
SEPARATORS = {";": "';'", "\t": "tabs", ",": "commas", " ": "spaces"}
# A header is looked for in this many lines: titles of measuring programs are shorter.
MAX_TITLE_LINES = 50
# A line above the header that gives Excel the separator.
EXCEL = "sep=(.|tab)?"
# The last line of each of two preambles of LabVIEW's measurement files, and the name of their columns of times.
LABVIEW, LABVIEW_TIME = "***End_of_Header***", "X_Value"
# 1,234.5 and 1,234,567
THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:[., ']\d{3})+[.,]\d*")
# 1,250 is 1250 or 1.25; 0,250 is 0.25 alone.
THOUSANDS_OR_DECIMALS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
# 1.5D+00, as Fortran writes numbers of double precision.
DOUBLE = re.compile(r"(\d\.\d*|\.\d+)[dD](?=[+-]\d{2,3}(?!\w))")
# Rows of the file, from 1: their text, and their cells.
Lines = list[tuple[int, str]]
Rows = list[tuple[int, Sequence[str]]]


def cells_of(line: str, separator: str = ",") -> list[str]:
    """The cells of a line, without the quotes and spaces around them; a separator between quotes is part of a cell."""
    parts = line.split() if separator == " " else line.split(separator)
    if '"' not in line:
        return [cell.strip() for cell in parts]
    if separator != " ":
        # The csv module refuses a cell of more than 131 072 characters.
        with suppress(csv.Error):
            parts = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return [cell.strip().strip('"').strip() for cell in parts]


def has_samples(path: PathLike) -> bool:
    """Whether a line of a text file has two numbers, as every sample has: notes and lists of properties have none."""

    def is_sample(line: str) -> bool:
        numbers = {separator: [is_number(cell) for cell in cells_of(line, separator)] for separator in SEPARATORS}
        # Words between spaces are a sentence, in which numbers may stand.
        return any(sum(found) > 1 and (separator != " " or all(found)) for separator, found in numbers.items())

    return any(map(is_sample, read_lines(path)))


def table_of(path: Path, lines: Sequence[str]) -> tuple[Rows, tuple[str, ...]]:
    """The cells of a file's table, header first, with decimal points; notes on the text.

    Lines without a value and comments are left out. A comment may be the header: the last comment before rows of
    numbers alone, with as many columns. Raise InputError if numbers have decimal commas in some rows and decimal points
    in others, or commas that may separate thousands.
    """
    written = [(i, DOUBLE.sub(r"\1E", line)) for i, line in enumerate(lines, 1) if line.strip(" \t;,")]
    written, preamble = _without_preamble(path, written)
    lines_of, notes = _with_header(written[1:] if written and re.fullmatch(EXCEL, written[0][1].strip()) else written)
    lines_of, above = _without_titles(lines_of)
    notes += [*preamble, *above]
    separator = (_separator(lines_of[0][1], lines_of[1][1]) if len(lines_of) > 1 else None) or ","
    if separator != ",":
        notes.append(f"columns are separated by {SEPARATORS[separator]}")
    rows: Rows = [(i, tuple(cells_of(line, separator))) for i, line in lines_of]
    may_have_commas = separator != "," or any('"' in line for _, line in lines_of)
    if may_have_commas and any("," in cell for _, cells in rows[1:] for cell in cells):
        _check_decimals(path, rows[1:], separator)
        notes = [f"{notes[-1]}, and decimals by commas"] if separator != "," else ["decimals are written with commas"]
        rows[1:] = [(i, [cell.replace(",", ".") for cell in cells]) for i, cells in rows[1:]]
    # A comma in a header's cell stands between several names.
    rows[:1] = [(i, [cell.replace(",", "") for cell in cells]) for i, cells in rows[:1]]
    return _without_empty_ends(rows), tuple(notes)


def _all_numbers(cells: Sequence[str]) -> bool:
    """Whether all cells are numbers, with decimal points or commas."""
    return all(is_number(cell.replace(",", ".")) for cell in cells)


def _without_empty_ends(rows: Rows) -> Rows:
    """The rows without the empty columns that spreadsheets write at the end of rows."""
    if all(cells[-1] for _, cells in rows):
        return rows
    filled = [max((k for k, cell in enumerate(cells, 1) if cell), default=1) for _, cells in rows]
    width = min(len(rows[0][1]), max(filled))
    return [(i, cells[: max(width, own)]) for (i, cells), own in zip(rows, filled, strict=True)]


def _with_header(written: Lines) -> tuple[Lines, list[str]]:
    """The rows without comments, except for a comment that is the header; and the note on that header."""
    rows = [(i, line) for i, line in written if not line.lstrip().startswith("#")]
    before = [(i, line.lstrip("# ")) for i, line in written if rows and i < rows[0][0]]
    if before and (found := _separator(before[-1][1], rows[0][1])) and _all_numbers(cells_of(rows[0][1], found)):
        return [before[-1], *rows], [f"the header is row {before[-1][0]}, behind #"]
    return rows, []


def _without_titles(rows: Lines) -> tuple[Lines, list[str]]:
    """The rows from the header on, without title lines above the table; and the note on these lines."""
    first = enumerate(rows[:MAX_TITLE_LINES])
    at = next((k for k, (_, line) in first if any(_has_time(line, mark) for mark in SEPARATORS)), 0)
    if at == 0 or not _is_header(rows[at : at + 3]):
        return rows, []
    labelled = _with_labels(*rows[at - 1 : at + 2])
    count = at - (labelled is not None)
    plural = "s" if count > 1 else ""
    notes = [f"{count} line{plural} above the header, which is row {rows[at][0]}, left out"] if count else []
    if labelled is not None:
        notes.append(f"row {rows[at - 1][0]} names the bodies of the columns below")
    return [labelled or rows[at], *rows[at + 1 :]], notes


def _with_labels(above: tuple[int, str], header: tuple[int, str], below: tuple[int, str]) -> tuple[int, str] | None:
    """The header with the labels of the line above it, mass_A_x and mass_B_x; None if these tell no columns apart.

    Programs that track bodies in a video write the name of a body above the first of its columns x and y.
    """
    separator = _separator(header[1], below[1]) or ","
    names, labels = (cells_of(line, separator) for _, line in (header, above))
    label, found = "", []
    for k, name in enumerate(names):
        label = labels[k] if k < len(labels) and labels[k] else label
        found.append(f"{label}_{name}".replace(" ", "_") if label and names.count(name) > 1 else name)
    several = len(set(found)) == len(found) > len(set(names))
    return (header[0], separator.join(found)) if several else None


def _without_preamble(path: Path, written: Lines) -> tuple[Lines, list[str]]:
    """The rows below the last line that ends a preamble of LabVIEW, with one time, and a note.

    X_Value is a time in s, which may stand before each channel; the last column may be of comments. Raise InputError if
    channels have different times, or none.
    """
    ends = [k for k, (_, line) in enumerate(written[:MAX_TITLE_LINES], 1) if line.startswith(LABVIEW)]
    if not ends or ends[-1] == len(written):
        return written, []
    notes = [f"{ends[-1]} lines above the header, which is row {written[ends[-1]][0]}, left out"]
    separator = "\t" if "\t" in written[ends[-1]][1] else ","
    (row, heads), *rows = [(i, cells_of(line, separator)) for i, line in written[ends[-1] :]]
    if heads[0] != LABVIEW_TIME:
        return written[ends[-1] :], notes
    times = [k for k, name in enumerate(heads) if name == LABVIEW_TIME]
    for i, cells in rows:
        seen = {cells[k] for k in times if k < len(cells)}
        one = "save them with one column of times (X_Columns: One)"
        refuse({
            f"{path}, row {i}: {LABVIEW_TIME} is blank; {one}": seen == {""},
            f"{path}, row {i}: channels have different times, {' and '.join(map(quote, sorted(seen)))}; {one}, or a "
            "file for each channel": len(seen) > 1,
        })  # fmt: skip
    remarks = heads[-1] == "Comment" and not any(cells[-1] for _, cells in rows if len(cells) == len(heads))
    left_out = {*times[1:], *([len(heads) - 1] if remarks else [])}
    lines = [(row, [f"{LABVIEW_TIME} [s]", *heads[1:]]), *rows]
    return [
        (i, separator.join(cell for k, cell in enumerate(cells) if k not in left_out)) for i, cells in lines
    ], notes  # fmt: skip


def _has_time(line: str, separator: str) -> bool:
    """Whether a line names a time beside another column."""
    heads = [name_and_unit(cell) for cell in cells_of(line, separator)]
    return len(heads) > 1 and any(head is not None and is_time(*head) for head in heads)


def _is_header(rows: Lines) -> bool:
    """Whether the first of these rows is followed by numbers in as many columns, or by units and then numbers."""
    if len(rows) < 2 or (separator := _separator(rows[0][1], rows[1][1])) is None:
        return False
    below = [cells_of(line, separator) for _, line in rows[1:]]
    units = any(kind_of(cell.strip("[]()<> ")) == "time" for cell in below[0])
    numbers = [cell for cell in below[-1 if units else 0] if cell.casefold() not in MISSING]
    return bool(numbers) and _all_numbers(numbers)


def _separator(header: str, row: str) -> str | None:
    """The first separator that gives both lines as many columns, two or more."""
    for separator in SEPARATORS:
        counts = {len(cells_of(line.rstrip(f" {separator}"), separator)) for line in (header, row)}
        # The last cells of a line may be empty.
        same = len(cells_of(header, separator)) == len(cells_of(row, separator))
        if max(counts) > 1 and (len(counts) == 1 or same):
            return separator
    return None


def _check_decimals(path: Path, table: Rows, separator: str) -> None:
    """Raise if a comma may separate thousands, or 1,5 and 2.5 stand in the same table.

    Programs that write commas between columns often write commas between thousands, too: in their tables at least one
    comma has to be a decimal sign for certain.
    """
    rows = table if separator == "," else ()
    numbers = [(i, cell) for i, cells in rows for cell in cells if "," in cell and is_number(cell.replace(",", "."))]
    if numbers and all(THOUSANDS_OR_DECIMALS.fullmatch(cell) for _, cell in numbers):
        i, cell = numbers[0]
        both = f"{cell.replace(',', '')} or {cell.replace(',', '.')}"
        raise InputError(f"{path}, row {i}: {cell!r} may be {both}; write numbers without separators of thousands")
    first: dict[str, tuple[int, str]] = {}
    for i, cells in table:
        for cell in cells:
            sign = "," if "," in cell else "."
            if sign == "," and THOUSANDS.fullmatch(cell):
                raise InputError(f"{path}, row {i}: {cell!r} has a separator of thousands; write numbers without it")
            if sign in cell and sign not in first and is_number(cell.replace(",", ".")):
                first[sign] = i, cell
        if len(first) == 2:
            (one, a), (two, b) = first.values()
            raise InputError(f"{path}, row {two}: {b!r} beside {a!r} in row {one}; write all decimals with one sign")


# Comments about inputs (hold, delay, lag) and about sensors (zero, scale).
SETTING = re.compile(r"#\s*(hold|delay|lag|zero|scale):\s*(.+)")


def read_csv(path: PathLike, wanted: Wanted = HEADER_DECIDES) -> Trajectories:
    """Read trajectories from a csv file; `wanted` gives columns their roles, and names and units decide the others.

    `herglotz.data.load` takes the roles as keywords (`time=`, `coordinates=`, …), and angles; here the roles are a
    `herglotz.data.csv_columns.Wanted`.

    **Text.** UTF-8. Commas, semicolons, tabs or spaces separate columns; unless commas do, decimals may have a comma.
    Exponents may stand behind D, as Fortran writes them.
    The header's cells are `name`, `name[unit]`, `name (unit)`, or with a known unit `name(unit)`, `name/unit`,
    `name in unit`, `name_unit` as in `tip_um`, `speed_rpm`, `v_m_s`, or `angleDeg` (`herglotz.data.column_roles` says
    where the end of a name is an index). The header may stand behind #, as `numpy.savetxt` writes headers, and units
    may stand in a row of their own below the header. Names of bodies in the line above it stand before the names of
    columns that come twice: `mass_A_x`, `mass_B_x`. Other lines that start with # and blank lines are skipped, except
    for these comments: `# hold: zero` (or `first`, `smooth`) is the hold of the inputs between samples,
    `# delay: 0.004` and `# lag: 0.02` are their delay and lag in the file's unit of time, and `# zero: 0.02 -0.1` and
    `# scale: 1 0.5` make q = scale · (reading − zero) of the coordinates in order (`herglotz.data.sensors`).

    **Roles.** `t`, `time`, `timestamp`, `Zeit`, `temps`, `tiempo` `millis`, `micros`, which say their unit, or the only
    column in a unit of time is the time; of several such columns, the one that increases. So is the stamp of a message
    of ROS (`header.stamp`). Times may be dates in ISO 8601, which become seconds since the first row. Stamps without a
    unit of about 1e12, 1e15 and 1e18 are ms, us and ns since 1970; above 2^53, stamps count from the first row. A
    number in brackets belongs to the name: `position[0]`. `trajectory`, `trial`, `run`, `experiment`, `Versuch`,
    `Essai` or such a name (`run_nr`, `trial id`) without a unit groups the rows; else, with a warning, a column that
    changes wherever time starts anew, and nowhere else, does: numbers of no length or angle, or text. A clock that
    falls back within such a group, or without one, begins a recording, with a warning. Text, and numbers without a unit
    and a usual name, that are the same in every row are left aside beside other coordinates. `s` is the action,
    `p`/`p_*` are momenta. Of other columns the unit decides before the name (`herglotz.data.column_roles`): rad, deg,
    m, mm, mil, px are positions; N, Nm, lb, A, V, % inputs, and so is a pulse width (`pwm [us]`); m/s, rad/s, rpm
    rates; rates are left aside, and so are °C, Pa, W, and, unless no other column is a coordinate, Wb, T, H and F. A
    set value of a motion is an input in any unit: goal, target, set point, desired, reference, command, soll; so is
    what shakes a mechanism: road, ground, excitation, Erregung; a floor, unless it has a number or a base or a ground
    is recorded, too: then it is a storey. A share of a nominal value (pu) is an input, unless its name is that of a
    position or a rate. Without a unit `u`, `u1`, `u_*`, `F`, force, torque,
    tau, voltage, motor are inputs; `v`, `vx`, velocity, `*_dot`, `dx`, `qd1` rates; errors, temperatures, batteries,
    counters (`index`, `frame`, a first column without a name) and filtered copies of another column (`theta_filt`) are
    left aside; every other column is a coordinate. A coordinate in rad is taken for an angle. A warning names every
    role that is a guess.

    **Missing values.** A coordinate that is empty or NaN has no weight in a fit (`Trajectories.observed`), and neither
    has a number that stands for a missing reading, such as -999 among millimetres (`herglotz.data.marks`). A row
    without any coordinate, or without s or a momentum, is left out; the step over that row has the mean of the inputs.
    An empty input is held from the row before, or interpolated linearly if the hold is "first" or "smooth". Rows of
    stacked tables are sorted by time, and rows of equal time joined.

    Returns
    -------
    Trajectories
        In float64, as measured (`load` unwraps angles and converts degrees and milliseconds); `columns` holds the role
        of every column.

    InputError names file, row (line of the file, from 1), column, value and remedy.
    """
    path = Path(path)
    lines = read_lines(path)
    rows, notes = table_of(path, lines)
    if not rows:
        raise InputError(f"{path}: there is no header; add a first line such as t[s],q[rad]")
    (at, heads), *rows = rows
    where, below = f"{path}, row {at}", any(mark in line for line in lines[at:] for mark in ",;\t")
    title = f"{where}: {quote(lines[at - 1])} is no header; delete the lines above the table, or begin them with #"
    refuse({title: len(heads) == 1 and below})

    @cache
    def columns() -> list[np.ndarray]:
        for row, cells in rows:
            if len(cells) != len(heads):
                counts = f"{len(cells)} cells where the header has {len(heads)}"
                raise InputError(f"{path}, row {row}: {counts}; correct or delete the row")
        return [np.array([cells[i] for _, cells in rows], dtype=object) for i in range(len(heads))]

    sheet = Sheet(
        path, where, heads, rows[0][1] if rows else [], [row for row, _ in rows], lambda i: columns()[i],
        notes=notes, settings=_settings(path, lines),
    )  # fmt: skip
    return from_sheet(sheet, wanted)


def _settings(path: Path, lines: Iterable[str]) -> dict[str, Any]:
    """Hold, delay, lag, zeros and scales from the first comment of each kind."""
    found: dict[str, Any] = {}
    for match in filter(None, (SETTING.fullmatch(line.strip()) for line in lines)):
        name, text = match.groups()
        where = f"{path.name}, comment '# {name}: {text}'"
        if name in ("zero", "scale"):
            found.setdefault(name, [number(x, where) for x in text.replace(",", " ").split()])
        else:
            found.setdefault(name, text if name == "hold" else number(text, where))
    return found


def write_csv(path: PathLike, trajectories: Trajectories, *, comments: Sequence[str] = ()) -> None:
    """Write trajectories so that `read_csv` returns the same numbers, bit for bit, atomically.

    `comments` become lines that start with #. Positions that were not read are NaN. A coordinate in rad that is not an
    angle is written too, although `read_csv` reads it as an angle; and so are numbers that `read_csv` takes for marks
    of missing readings (`herglotz.data.marks`): a set that holds -999 among millimetres comes back from .npz. Raise
    InputError if a coordinate's name or a unit cannot stand in the header, because of a comma or because the name means
    another column.
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
