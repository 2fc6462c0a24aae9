"""Tables as spreadsheets, loggers and `numpy.savetxt` write them: separators, decimal commas, a header behind #."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from herglotz.data.csv_columns import is_number
from herglotz.errors import InputError

# Separators in the order in which they are tried; a comma last but one, as it may be the decimal sign of the others.
SEPARATORS = {";": "';'", "\t": "tabs", ",": "commas", " ": "spaces"}
Rows = list[tuple[int, str]]  # row of the file, from 1, and its text


def cells_of(line: str, separator: str = ",") -> list[str]:
    """The cells of a line, without the quotes and spaces around them."""
    parts = line.split() if separator == " " else line.split(separator)
    return [cell.strip().strip('"').strip() for cell in parts]


def in_commas(
    path: Path,  # begins messages
    lines: Sequence[str],  # of the file
) -> tuple[Rows, tuple[str, ...]]:
    """Rows of a table, header first, with commas between columns and decimal points; and notes on what was changed.

    Lines without a value and comments are left out, unless a comment is the header: the last one before rows of numbers
    alone, in as many columns.

    Raises
    ------
    InputError
        If numbers have decimal commas in some rows and decimal points in others.
    """
    rows, notes = _with_header([(i, line) for i, line in enumerate(lines, 1) if line.strip(" \t;,")])
    separator = _separator(rows[0][1], rows[1][1]) if len(rows) > 1 else None
    if separator in (None, ","):
        return rows, tuple(notes)
    notes.append(f"columns are separated by {SEPARATORS[separator]}")
    if any("," in line for _, line in rows[1:]):
        _check_decimals(path, rows[1:], separator)
        notes[-1] += ", and decimals by commas"
    return [(i, ",".join(_with_points(cells_of(line, separator)))) for i, line in rows], tuple(notes)


def _with_header(written: Rows) -> tuple[Rows, list[str]]:
    """The rows without comments, but for one that is the header; and the note that says so."""
    rows = [(i, line) for i, line in written if not line.lstrip().startswith("#")]
    before = [(i, line.lstrip("# ")) for i, line in written if rows and i < rows[0][0]]
    if before and (found := _separator(before[-1][1], rows[0][1])) and _all_numbers(rows[0][1], found):
        return [before[-1], *rows], [f"the header is row {before[-1][0]}, behind #"]
    return rows, []


def _separator(header: str, row: str) -> str | None:
    """The first separator that gives both lines as many columns, two or more."""
    for separator in SEPARATORS:
        count = len(cells_of(header, separator))
        if count > 1 and count == len(cells_of(row, separator)):
            return separator
    return None


def _with_points(cells: Sequence[str]) -> list[str]:
    return [cell.replace(",", ".") for cell in cells]


def _all_numbers(row: str, separator: str) -> bool:
    return all(is_number(cell) for cell in _with_points(cells_of(row, separator)))


def _check_decimals(path: Path, rows: Rows, separator: str) -> None:
    """Raise where 1,5 and 2.5 stand in one table: one of the two signs may separate thousands."""
    first: dict[str, tuple[int, str]] = {}
    for i, line in rows:
        for cell in cells_of(line, separator):
            sign = "," if "," in cell else "."
            if sign in cell and sign not in first and is_number(cell.replace(",", ".")):
                first[sign] = i, cell
        if len(first) == 2:
            (one, a), (two, b) = first.values()
            raise InputError(f"{path}, row {two}: {b!r} beside {a!r} in row {one}; write all decimals with one sign")
