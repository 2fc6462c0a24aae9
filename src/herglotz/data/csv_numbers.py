"""Rows of plain numbers as numpy's parser takes them, a fifth of the time and of the memory of cells read by hand."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from herglotz.data.checks import EXACT

LONG = 100_000  # characters of a row of plain numbers
SHOWN = 40  # characters of a row in an error, which nobody sees


@dataclass
class NumberLines:
    """The rows of a table below its header; numbers and comments of those that were read."""

    separator: str  # of columns; " " for blanks
    width: int  # columns
    first: int  # line of the file, from 1, at which they start
    at: list[int] = field(default_factory=list)  # line of each row
    comments: list[str] = field(default_factory=list)

    def parsed(self, lines: Iterable[str], columns: Sequence[int]) -> np.ndarray:
        """These columns of all rows, (N, k); NaN for an empty cell.

        Raise ValueError where a cell is no plain number, or a row has another number of cells.
        """
        delimiter = None if self.separator == " " else self.separator
        table = np.loadtxt(self._rows(lines), delimiter=delimiter, comments=None, ndmin=2, usecols=columns)
        known = table[~np.isnan(table)]
        if len(known) and not np.abs(known).max() < EXACT:
            raise ValueError("infinite, or an integer that float64 rounds")
        return table

    def _rows(self, lines: Iterable[str]) -> Iterator[str]:
        commas = points = False  # as decimal signs, where the separator is another
        for number, line in enumerate(lines, self.first):
            if line.startswith("#"):
                self.comments.append(line)
                continue
            if not line.strip(" \t;,\r\n"):
                continue
            row = line.rstrip("\n")
            if len(row) > LONG or self._cells(row) != self.width:
                raise ValueError(row[:SHOWN])
            if self.separator != ",":
                commas, points = commas or "," in row, points or "." in row
                if commas and points:
                    raise ValueError("two decimal signs")
                row = row.replace(",", ".")
            self.at.append(number)
            yield self._with_blanks(row)

    def _cells(self, row: str) -> int:
        return len(row.split()) if self.separator == " " else row.count(self.separator) + 1

    def _with_blanks(self, row: str) -> str:
        """The row with NaN in its empty cells."""
        mark = self.separator
        if mark == " " or not (mark + mark in row or row[0] == mark or row[-1] == mark):
            return row
        return mark.join(cell or "nan" for cell in row.split(mark))
