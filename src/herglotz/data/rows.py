"""Rows of a text file: numbers parsed and samples grouped, with messages that name file, row, column and value."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from herglotz.data.checks import EXACT, MIN_SAMPLES
from herglotz.errors import InputError

SHOWN = 40  # characters of a bad cell that a message quotes
MISSING = ("", "nan", "na", "n/a", "#n/a", "null", "none")  # cells of programs for a missing value


class Unusable(InputError):
    """A recording that is too short or out of order: others of the same set can be used without it."""


def quote(text: str) -> str:
    """Quote a cell for a one-line message: control characters escaped, long text cut."""
    return repr(text if len(text) <= SHOWN else text[:SHOWN] + "…")


def number(
    text: str,  # a cell
    where: str,  # file, row and column: begins the message
) -> float:
    """Parse a finite number; raise InputError if the cell is blank, not a number, NaN or infinite."""
    try:
        value = float(text)
    except ValueError:
        value = None
    if value is None or "_" in text:  # Python reads 1_000 as a number; in a data file it is a mistake
        what = quote(text) if text else "a blank cell"
        raise InputError(f"{where}: {what} is not a number; correct or delete the row")
    if abs(value) >= EXACT and text.strip("+-").isdecimal() and int(text) != value:
        raise InputError(f"{where}: {quote(text)} is above 2^53 and would be rounded; subtract the first one from all")
    if not math.isfinite(value):
        raise InputError(f"{where}: {quote(text)} is not finite; correct or delete the row")
    return value


def number_or_none(text: str, where: str) -> float:
    """As `number`, but NaN for a cell without a value: the sample is missing."""
    return math.nan if text.casefold() in MISSING else number(text, where)


def group_rows(
    path: Path,
    rows: Sequence[int],  # line of the file, from 1, of each sample
    labels: Sequence[str],  # trajectory of each sample; "" when the file has one
    t: Sequence[float],  # time of each sample
    columns: tuple[str, str] = ("trajectory", "t"),  # names of label and time in the file
) -> list[list[int]]:
    """Return the sample numbers of each trajectory, in order of first appearance.

    Raise Unusable, an InputError, if there is no sample, a trajectory has fewer than three, or its time does not
    increase.
    """
    if not rows:
        raise Unusable(f"{path}: there is a header but no samples; add at least {MIN_SAMPLES} rows")
    groups: dict[str, list[int]] = {}
    for i, label in enumerate(labels):
        groups.setdefault(label, []).append(i)
    for label, group in groups.items():
        if len(group) < MIN_SAMPLES:
            has = f"has {len(group)} sample{'s' if len(group) > 1 else ''}, at least {MIN_SAMPLES} are needed"
            where = f"{path}, row {rows[group[0]]}"
            if label:
                raise Unusable(f"{where}, column '{columns[0]}': {quote(label)} {has}; delete it or add rows")
            raise Unusable(f"{where}: the file {has}; add rows")
        for one, two in pairwise(group):
            if not t[two] > t[one]:
                raise Unusable(
                    f"{path}, row {rows[two]}, column '{columns[1]}': {t[two]!r} does not increase on {t[one]!r} in "
                    f"row {rows[one]}; sort the rows, delete one, or number the trajectories in a column 'trajectory' "
                    "(another name: --group NAME, group= in Python)"
                )
    return list(groups.values())
