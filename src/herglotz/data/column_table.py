"""A recording in words: a summary of one line, and the table of its columns with notes and warnings."""

from __future__ import annotations

import math
from typing import Any

from herglotz.data.column_roles import is_angular

# Role of a column of u that was computed from a recorded input.
INPUT_TERM = "input term"
# Begins a note that is printed outside of the table, too.
WARNING = "warning: "


def column_table(data: Any) -> str:
    """Return a line for each column of `Trajectories`: role, unit, and the conversion of the unit; then the notes."""
    rows = [("column", "is taken for", "unit"), *column_rows(data)]
    widths = [max(len(row[k]) for row in rows) for k in range(2)]
    lines = [f"  {a:<{widths[0]}}  {b:<{widths[1]}}  {c}" for a, b, c in rows]
    source = data.source or "table"
    notes = [f"  {note}" for note in data.notes if not note.startswith(WARNING)]
    warnings = [f"{WARNING}{source}: {note[len(WARNING) :]}" for note in data.notes if note.startswith(WARNING)]
    return "\n".join([f"{source}:", *lines, *notes, *warnings])


def summary_of(data: Any) -> str:
    """Return a line on `Trajectories`: coordinates and inputs, the number of samples, and the steps."""
    coordinates = ", ".join(f"{name} [{unit}]" for name, unit in zip(data.names, data.units, strict=True))
    known = "".join(f", {name}" for name in "sp" if getattr(data, name) is not None)
    known += "".join(f", input {name}" + (f" [{unit}]" if unit else "") for name, unit in data.input_labels)
    plural, unit = "y" if len(data) == 1 else "ies", "" if data.time_unit == "1" else f" {data.time_unit}"
    gaps = f", {data.gaps} gap{'' if data.gaps == 1 else 's'}" if data.gaps else ""
    h = data.steps().h
    irregular = f"irregular steps, {float(h.min()):.3g} to {float(h.max()):.3g}{unit}"
    step = irregular if data.irregular else f"step {data.typical_step:.4g}{unit}{gaps}"
    return (
        f"{data.source or 'trajectories'}: {len(data)} trajector{plural}, {data.samples} samples of "
        f"{coordinates}{known}; {step}"
    )


def of_file(name: str, note: str) -> str:
    """A note on a single file of several."""
    return f"{WARNING}{name}: {note[len(WARNING) :]}" if note.startswith(WARNING) else f"{name}: {note}"


def column_rows(data: Any) -> list[tuple[str, str, str]]:
    """Name, final role and final unit of each column of `Trajectories`, in words."""
    now = dict(zip(data.names, zip(data.units, data.angles, strict=True), strict=True))
    rows = []
    for name, role, unit in data.columns:
        if role == "coordinate" and name in now:
            role = "angle" if now[name][1] else role
            unit = _converted(unit, now[name][0])
            if role == "coordinate" and not unit and is_angular(name):
                far = float(data.q[:, data.names.index(name)].abs().max()) > 2 * math.pi
                unit = f"- (an angle in {'deg? --degrees' if far else 'rad? --angles'} {name})"
        elif role == "polar":
            role, unit = "angle", "rad"
        elif role == "time":
            unit = _converted(unit, data.time_unit) if unit else f"- (taken for {data.time_unit})"
        rows.append((name, role, unit or "-"))
    return rows


def _converted(unit: str, now: str) -> str:
    """The unit of a column, and the unit after conversion; for a column without a unit the assigned unit."""
    given = "" if now == "1" else now
    return unit if unit == now else f"{unit}, converted to {now}" if unit else given
