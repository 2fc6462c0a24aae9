"""Cells of a text file as numbers, with messages that name file, row, column and value."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

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


def out_of_order(values: np.ndarray, starts: np.ndarray, names: Sequence[str]) -> str:
    """The remedy for times that do not increase at the rows `starts` of a table, whose columns have these names.

    A column that changes there and nowhere else numbers the recordings.
    """
    changes = np.diff(values, axis=0) != 0
    expected = np.isin(np.arange(1, len(values)), starts)
    numbered = [name for name, own in zip(names, changes.T, strict=True) if bool((own == expected).all())]
    if len(starts) > 1 and numbered:
        return f"column '{numbered[0]}' changes wherever time starts anew: --group {numbered[0]} (group= in Python)"
    return (
        "sort the rows, delete one, or number the trajectories in a column 'trajectory' (another name: --group NAME, "
        "group= in Python)"
    )
