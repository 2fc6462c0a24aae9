"""Angles in degrees whose header gives no unit: the user names these coordinates, or their motion shows the unit."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.column_roles import is_angular
from herglotz.data.csv_columns import Names, as_names
from herglotz.data.trajectories import DEGREES, TAKEN_FOR_DEGREES, Trajectories
from herglotz.data.units import in_radians_and_seconds
from herglotz.errors import check_coordinates

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
        return _converted(data, set(as_names(degrees)) - set(data.degrees), ())
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
    return _converted(data, found, notes)


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


def _converted(data: Trajectories, names: Collection[str], notes: Collection[str]) -> Trajectories:
    """The set with these coordinates converted from degrees to rad; the table of columns names the assumed unit."""
    units = tuple(DEGREES[0] if name in names else unit for name, unit in zip(data.names, data.units, strict=True))
    angles = tuple(angle and name not in names for name, angle in zip(data.names, data.angles, strict=True))
    columns = tuple((name, role, TAKEN_FOR_DEGREES if name in names else unit) for name, role, unit in data.columns)
    data = replace(data, units=units, angles=angles, columns=columns, notes=(*data.notes, *notes))
    return in_radians_and_seconds(data)
