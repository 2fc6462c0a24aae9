"""What every column of a table was taken for, in words."""

from __future__ import annotations

import re
from collections.abc import Sequence

from herglotz.data.checks import Labels

ANGULAR = re.compile(r"(theta|phi|psi|angle|alpha|beta)(_?\d+|_.*)?", re.I)  # names that are given to angles


def column_table(
    columns: Sequence[tuple[str, str, str]],  # name, role and unit of each column, as it was read
    labels: Labels,  # of what was made of them
    source: str,
    notes: Sequence[str] = (),
) -> str:
    """Return a line a column: its role, and its unit with the conversion that was made; then the notes."""
    rows = [("column", "is taken for", "unit"), *column_rows(columns, labels)]
    widths = [max(len(row[k]) for row in rows) for k in range(2)]
    lines = [f"  {a:<{widths[0]}}  {b:<{widths[1]}}  {c}" for a, b, c in rows]
    return "\n".join([f"{source or 'table'}:", *lines, *(f"  {note}" for note in notes)])


def column_rows(columns: Sequence[tuple[str, str, str]], labels: Labels) -> list[tuple[str, str, str]]:
    """Name, role and unit of each column, in words, after all that was said of it and made of it."""
    now = dict(zip(labels.names, zip(labels.units, labels.angles, strict=True), strict=True))
    rows = []
    for name, role, unit in columns:
        if role == "coordinate" and name in now:
            role = "angle" if now[name][1] else role
            unit = _converted(unit, now[name][0])
            if role == "coordinate" and not unit and ANGULAR.fullmatch(name):
                unit = f"- (an angle in rad? --angles {name})"
        elif role == "time":
            unit = _converted(unit, labels.time_unit) if unit else f"- (taken for {labels.time_unit})"
        rows.append((name, role, unit or "-"))
    return rows


def _converted(unit: str, now: str) -> str:
    """The unit of a column, and what it became; of a column without a unit the one that it was given since."""
    given = "" if now == "1" else now
    return unit if unit == now else f"{unit}, converted to {now}" if unit else given
