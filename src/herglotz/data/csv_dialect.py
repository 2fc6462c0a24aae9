"""Tables as spreadsheets, loggers and `numpy.savetxt` write them: separators, decimal commas, a header behind #."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from herglotz.data.column_roles import is_time, kind_of
from herglotz.data.csv_columns import is_number
from herglotz.data.header_cells import name_and_unit
from herglotz.data.rows import MISSING
from herglotz.errors import InputError

# Separators in the order of trial; the comma stands last but one, because a comma may be a decimal sign.
SEPARATORS = {";": "';'", "\t": "tabs", ",": "commas", " ": "spaces"}
# A header is looked for in this many lines: titles of measuring programs are shorter.
MAX_TITLE_LINES = 50
# A line above the header that gives Excel the separator.
EXCEL = "sep=(.|tab)?"
# 1,234.5 and 1,234,567
THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:[., ']\d{3})+[.,]\d*")
# 1,250 is 1250 or 1.25; 0,250 is 0.25 alone.
THOUSANDS_OR_DECIMALS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
# Row of the file, from 1, and its text.
Rows = list[tuple[int, str]]
Cells = Iterable[tuple[int, list[str]]]


def cells_of(line: str, separator: str = ",") -> list[str]:
    """The cells of a line, without the quotes and spaces around them; a separator between quotes is part of a cell."""
    parts = line.split() if separator == " " else line.split(separator)
    if '"' in line and separator != " ":
        # The csv module refuses a cell of more than 131 072 characters.
        with suppress(csv.Error):
            parts = next(csv.reader([line], delimiter=separator, skipinitialspace=True))
    return [cell.strip().strip('"').strip() for cell in parts]


def in_commas(path: Path, lines: Sequence[str]) -> tuple[Rows, tuple[str, ...]]:
    """Rows of a file's table, header first, with commas between columns and decimal points; notes on the changes.

    Lines without a value and comments are left out. A comment may be the header: the last comment before rows of
    numbers alone, with as many columns. Raise InputError if numbers have decimal commas in some rows and decimal points
    in others, or commas that may separate thousands.
    """
    written = [(i, line) for i, line in enumerate(lines, 1) if line.strip(" \t;,")]
    rows, notes = _with_header(written[1:] if written and re.fullmatch(EXCEL, written[0][1].strip()) else written)
    rows, above = _without_titles(rows)
    notes += above
    separator = (_separator(rows[0][1], rows[1][1]) if len(rows) > 1 else None) or ","
    if separator != ",":
        notes.append(f"columns are separated by {SEPARATORS[separator]}")
    elif not any('"' in line for _, line in rows):
        return _without_empty_ends(rows), tuple(notes)

    def table() -> Iterator[tuple[int, list[str]]]:
        return ((i, cells_of(line, separator)) for i, line in rows[1:])

    if any("," in cell for _, cells in table() for cell in cells):
        _check_decimals(path, table, separator)
        notes = [f"{notes[-1]}, and decimals by commas"] if separator != "," else ["decimals are written with commas"]
    # A comma in a header's cell stands between several names.
    names = ",".join(cell.replace(",", "") for cell in cells_of(rows[0][1], separator))
    points = ((i, ",".join(cell.replace(",", ".") for cell in cells)) for i, cells in table())
    return _without_empty_ends([(rows[0][0], names), *points]), tuple(notes)


def _all_numbers(cells: Sequence[str]) -> bool:
    """Whether all cells are numbers, with decimal points or commas."""
    return all(is_number(cell.replace(",", ".")) for cell in cells)


def _without_empty_ends(rows: Rows) -> Rows:
    """The rows without the empty columns that spreadsheets write at the end of rows."""
    if not any(line.rstrip().endswith(",") for _, line in rows):
        return rows
    filled = [line.rstrip(", \t").count(",") + 1 for _, line in rows]
    width = min(rows[0][1].count(",") + 1, max(filled))
    return [(i, ",".join(line.split(",")[: max(width, own)])) for (i, line), own in zip(rows, filled, strict=True)]


def _with_header(written: Rows) -> tuple[Rows, list[str]]:
    """The rows without comments, except for a comment that is the header; and the note on that header."""
    rows = [(i, line) for i, line in written if not line.lstrip().startswith("#")]
    before = [(i, line.lstrip("# ")) for i, line in written if rows and i < rows[0][0]]
    if before and (found := _separator(before[-1][1], rows[0][1])) and _all_numbers(cells_of(rows[0][1], found)):
        return [before[-1], *rows], [f"the header is row {before[-1][0]}, behind #"]
    return rows, []


def _without_titles(rows: Rows) -> tuple[Rows, list[str]]:
    """The rows from the header on, without title lines above the table; and the note on these lines."""
    first = enumerate(rows[:MAX_TITLE_LINES])
    at = next((k for k, (_, line) in first if any(_has_time(line, mark) for mark in SEPARATORS)), 0)
    if at == 0 or not _is_header(rows[at : at + 3]):
        return rows, []
    plural = "s" if at > 1 else ""
    return rows[at:], [f"{at} line{plural} above the header, which is row {rows[at][0]}, left out"]


def _has_time(line: str, separator: str) -> bool:
    """Whether a line names a time beside another column."""
    heads = [name_and_unit(cell) for cell in cells_of(line, separator)]
    return len(heads) > 1 and any(head is not None and is_time(*head) for head in heads)


def _is_header(rows: Rows) -> bool:
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


def _check_decimals(path: Path, table: Callable[[], Cells], separator: str) -> None:
    """Raise if a comma may separate thousands, or 1,5 and 2.5 stand in the same table.

    Programs that write commas between columns often write commas between thousands, too: in their tables at least one
    comma has to be a decimal sign for certain.
    """
    rows = table() if separator == "," else ()
    numbers = [(i, cell) for i, cells in rows for cell in cells if "," in cell and is_number(cell.replace(",", "."))]
    if numbers and all(THOUSANDS_OR_DECIMALS.fullmatch(cell) for _, cell in numbers):
        i, cell = numbers[0]
        both = f"{cell.replace(',', '')} or {cell.replace(',', '.')}"
        raise InputError(f"{path}, row {i}: {cell!r} may be {both}; write numbers without separators of thousands")
    first: dict[str, tuple[int, str]] = {}
    for i, cells in table():
        for cell in cells:
            sign = "," if "," in cell else "."
            if sign == "," and THOUSANDS.fullmatch(cell):
                raise InputError(f"{path}, row {i}: {cell!r} has a separator of thousands; write numbers without it")
            if sign in cell and sign not in first and is_number(cell.replace(",", ".")):
                first[sign] = i, cell
        if len(first) == 2:
            (one, a), (two, b) = first.values()
            raise InputError(f"{path}, row {two}: {b!r} beside {a!r} in row {one}; write all decimals with one sign")
