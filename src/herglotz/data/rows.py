"""Cells of a text file as numbers, with messages that name file, row, column and value."""

from __future__ import annotations

import math

from herglotz.data.checks import EXACT
from herglotz.errors import InputError

# Characters of a bad cell that a message quotes.
MAX_QUOTED = 40
# What programs write for a missing value.
MISSING = ("", "nan", "na", "n/a", "#n/a", "null", "none")


class Unusable(InputError):
    """A recording that is too short or out of order: the other recordings of the set can be used without it."""


def quote(text: str) -> str:
    """Quote a cell for a one-line message: control characters escaped, long text cut."""
    return repr(text if len(text) <= MAX_QUOTED else text[:MAX_QUOTED] + "…")


def number(text: str, where: str) -> float:
    """The finite number in a cell.

    Raise InputError, which begins with `where` (file, row and column), if the cell is blank, not a number, NaN,
    infinite, or an integer that float64 rounds.
    """
    try:
        value = float(text)
    except ValueError:
        value = None
    # Python reads 1_000 as a number; in a data file the underscore is a mistake.
    if value is None or "_" in text:
        what = quote(text) if text else "a blank cell"
        raise InputError(f"{where}: {what} is not a number; correct or delete the row")
    if abs(value) >= EXACT and text.strip("+-").isdecimal() and int(text) != value:
        raise InputError(f"{where}: {quote(text)} is above 2^53 and would be rounded; subtract the first one from all")
    if not math.isfinite(value):
        raise InputError(f"{where}: {quote(text)} is not finite; correct or delete the row")
    return value
