"""Units: degrees and radians, times in seconds, and angles in degrees whose header gives no unit; sizes in words.

The user names the coordinates in degrees, or their motion shows the unit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.column_roles import is_angular
from herglotz.data.csv_columns import Names, as_names
from herglotz.data.trajectories import DEGREES, GRAD, TAKEN_FOR_DEGREES, Trajectories
from herglotz.errors import check_coordinates

# How many of each unit of time make a second.
PER_SECOND = {
    "ms": 1e3, "us": 1e6, "µs": 1e6, "μs": 1e6, "ns": 1e9, "min": 1 / 60, "h": 1 / 3600,
    "sec": 1.0, "seconds": 1.0, "msec": 1e3, "usec": 1e6,
}  # fmt: skip


def in_radians_and_seconds(data: Trajectories) -> Trajectories:
    """Return the set with coordinates in degrees as angles in rad, and a time in ms, µs, ns, min or h in s."""
    if found := [name for name, unit in zip(data.names, data.units, strict=True) if unit == GRAD]:
        note = f"warning: {', '.join(found)} in {GRAD}: taken for degrees, 360 in a turn; with 400 in a turn, write gon"
        data = replace(data, notes=(*data.notes, note))
    degrees = [unit in DEGREES for unit in data.units]
    angles = tuple(turned or angle for turned, angle in zip(degrees, data.angles, strict=True))
    return in_seconds(replace(_converted(data, degrees, math.pi / 180, "rad"), angles=angles) if any(degrees) else data)


def _converted(data: Trajectories, chosen: Sequence[bool], factor: float, unit: str) -> Trajectories:
    """The set with the chosen coordinates times a factor, in this unit; the set has no angle among them."""
    factors = data.q.new_tensor([factor if x else 1.0 for x in chosen])
    return replace(
        data,
        q=data.q * factors,
        v=None if data.v is None else data.v * factors,
        units=tuple(unit if x else own for x, own in zip(chosen, data.units, strict=True)),
        angles=tuple(angle and not x for x, angle in zip(chosen, data.angles, strict=True)),
    )


def in_seconds(data: Trajectories) -> Trajectories:
    """Return the set with a time in ms, µs, ns, min or h in s."""
    if data.time_unit not in PER_SECOND:
        return data
    # A quotient by a power of ten is the float nearest to the decimal number: 300 ms prints as 0.3 s.
    count = PER_SECOND[data.time_unit]
    delay, lag = (None if x is None else x / count for x in data.arrival[1:])
    v = None if data.v is None else data.v * count
    return replace(data, t=data.t / count, v=v, time_unit="s", delay=delay, lag=lag)


def in_degrees(data: Trajectories, names: Collection[str]) -> Trajectories:
    """Return the set with these coordinates in deg, for a table for people (`load` converts degrees to radians).

    Momenta stay conjugate to radians.
    """
    chosen = [name in names and unit == "rad" for name, unit in zip(data.names, data.units, strict=True)]
    return _converted(data, chosen, 180 / math.pi, "deg")


def as_recorded(data: Trajectories) -> tuple[Trajectories, Tensor]:
    """The set in deg where the table had degrees, for figures, and the factor from rad to that unit, (n,)."""
    found = in_degrees(data, data.degrees)
    return found, data.q.new_tensor([180 / math.pi if unit == "deg" else 1.0 for unit in found.units])


def common_unit(units: Sequence[str]) -> str:
    """The unit that all coordinates have; "" for several units, and for plain numbers."""
    return units[0] if len(set(units)) == 1 and units[0] != "1" else ""


def size(value: float, unit: str, degrees: bool = False, digits: int = 3) -> str:
    """A length or an angle in words: `0.0021 rad = 0.12 deg` for a coordinate that was recorded in degrees."""
    also = f" = {math.degrees(value):.3g} deg" if degrees and unit == "rad" else ""
    return f"{value:.{digits}g} {unit}".removesuffix(" 1").rstrip() + also


def span(ends: Sequence[float], unit: str = "", degrees: bool = False) -> str:
    """A range in words: `-1 to 1 rad = -57.3 to 57.3 deg` if recorded in degrees, `0.1 s` for a range without width."""
    low, high = ends
    if f"{low:.3g}" == f"{high:.3g}":
        return size(high, unit, degrees)
    also = f" = {math.degrees(low):.3g} to {math.degrees(high):.3g} deg" if degrees and unit == "rad" else ""
    return f"{low:.3g} to {size(high, unit)}{also}"


# One full turn in each unit of angle.
TURN = {"rad": 2 * math.pi, "deg": 360.0}
# Part of the warning of positions in counts, by which the warning is found among notes.
COUNTS = "counts of an encoder"


def with_angles_in_degrees(
    data: Trajectories, degrees: Names | None, angles: Names | bool | None, like: Trajectories | None
) -> Trajectories:
    """The recorded set, angles not yet unwrapped, with the coordinates in degrees converted to rad.

    `degrees` are the user's names, () for none; None: a coordinate without a unit that has the name of an angle is in
    degrees if it reaches beyond 2π and moves too far between samples for an angle in rad (`is_in_degrees`), and so is a
    coordinate that was in degrees in the set `like`. `angles` are coordinates that the user calls angles in rad. Notes
    name each guess, and the remedy for a wrong guess. Raise InputError if no coordinate has a name in `degrees`.
    """
    if degrees is not None:
        check_coordinates(data.source, "degrees", as_names(degrees), data.names)
        return _from_degrees(data, set(as_names(degrees)) - set(data.degrees), ())
    known = {} if like is None else dict.fromkeys(like.names, "") | {name: unit for name, _, unit in like.columns}
    units = zip(data.names, data.units, strict=True)
    found = [name for name, unit in units if unit == "1" and known.get(name) == TAKEN_FOR_DEGREES]
    radians = data.names if angles is True else as_names(angles or ())
    notes = _notes_of_counts(data, known) if angles is None else []
    for name, unit, q in zip(data.names, data.units, data.q.T, strict=True):
        in_radians = unit == "rad" or name in radians
        angular = in_radians or (unit == "1" and angles is None and is_angular(name))
        if not angular or name in {*known, *data.degrees} or float(q.abs().max()) <= TURN["rad"]:
            continue
        in_degrees = is_in_degrees(data, q)
        if in_degrees and not in_radians:
            found.append(name)
        if in_degrees or not in_radians:
            notes.append(_note(name, float(q.abs().max()), in_radians, in_degrees))
    return _from_degrees(data, found, notes)


def is_in_degrees(data: Trajectories, q: Tensor) -> bool:
    """Whether a coordinate, (N,), is an angle in degrees, and not in rad.

    Removing turns of 360 from the steps of an angle in degrees leaves a steadier motion than removing turns of 2π. An
    angle in rad that is sampled often enough loses only its jumps by turns of 2π.
    """
    return not are_counts(q) and _unsteady(data, q, TURN["rad"]) > _unsteady(data, q, TURN["deg"])


def are_counts(q: Tensor) -> bool:
    """Whether a coordinate, (N,), may be counts of an encoder: whole numbers beyond 360."""
    return float(q.abs().max()) > TURN["deg"] and bool((q == q.round()).all())


def _notes_of_counts(data: Trajectories, known: Collection[str]) -> list[str]:
    """A warning for each coordinate without a unit that may be counts and is not `known`, which says what to give."""
    return [
        f"warning: whole numbers without a unit, {name} may be {COUNTS}: if a turn is N of them, give --sensor-scales "
        f"with the number 2π/N, and --angles {name}"
        for name, unit, q in zip(data.names, data.units, data.q.T, strict=True)
        if unit == "1" and name not in known and are_counts(q)
    ]


def _unsteady(data: Trajectories, q: Tensor, turn: float) -> float:
    """Mean change from step to step over the mean step, after removing whole turns from jumps."""
    steps = data.steps()
    d = q[steps.index + 1] - q[steps.index]
    d = d - turn * torch.round(d / turn)
    return float(d.diff().abs().mean() / d.abs().mean().clamp_min(torch.finfo(d.dtype).tiny))


def _note(name: str, largest: float, in_radians: bool, in_degrees: bool) -> str:
    """The warning of a coordinate that reaches beyond a turn: its assumed unit, and the remedy."""
    remedy, reaches = f"--degrees {name} (degrees= in Python)", f"reaches {largest:.4g}"
    if in_radians:
        why = f"{reaches} rad, and moves between samples as an angle in degrees"
        return f"warning: {name} {why}: {remedy}, if it is one"
    if in_degrees:
        why = f"it has no unit, {reaches}, and moves too far between samples for an angle in rad"
        return f"warning: {name} is taken for degrees: {why}; else give --degrees none (degrees=() in Python)"
    ways = f"{remedy}, an angle in rad by --angles {name}"
    return f"warning: {name} {reaches} without a unit, and is taken for a length; an angle in degrees is said by {ways}"


def _from_degrees(data: Trajectories, names: Collection[str], notes: Collection[str]) -> Trajectories:
    """The set with these coordinates converted from degrees to rad; the table of columns names the assumed unit."""
    units = tuple(DEGREES[0] if name in names else unit for name, unit in zip(data.names, data.units, strict=True))
    angles = tuple(angle and name not in names for name, angle in zip(data.names, data.angles, strict=True))
    columns = tuple((name, role, TAKEN_FOR_DEGREES if name in names else unit) for name, role, unit in data.columns)
    data = replace(data, units=units, angles=angles, columns=columns, notes=(*data.notes, *notes))
    return in_radians_and_seconds(data)
