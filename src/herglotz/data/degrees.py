"""Angles in degrees whose header does not say so: by the user's word, or as their motion shows."""

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
from herglotz.errors import InputError

TURN = {"rad": 2 * math.pi, "deg": 360.0}


def in_told_degrees(
    data: Trajectories,  # as recorded, angles not yet unwrapped
    degrees: Names | None,  # coordinates in degrees; () for none; None: as the motion shows
    angles: Names | bool | None,  # coordinates that the user calls angles in rad
    like: Trajectories | None = None,  # another recording: its columns mean the same here
) -> Trajectories:
    """The set with these coordinates in rad; notes say what was guessed, and what to do where a guess is not certain.

    A coordinate without a unit whose name is that of an angle is in degrees where it reaches beyond 2π and, were it in
    rad, its steps could not be told from steps of other turns (`is_in_degrees`). Raise InputError if a name is none of
    a coordinate.
    """
    if degrees is not None:
        for name in as_names(degrees):
            if name not in data.names:
                where = data.source or "data"
                raise InputError(f"{where}: degrees names {name!r}, but the coordinates are {data.names}")
        return _converted(data, set(as_names(degrees)) - set(data.degrees), ())
    found, notes, told = [], [], set(data.degrees)
    known = {} if like is None else dict.fromkeys(like.names, "") | {name: unit for name, _, unit in like.columns}
    for name, unit, q in zip(data.names, data.units, data.q.T, strict=True):
        said = unit == "rad" or angles is True or (not isinstance(angles, bool) and name in as_names(angles or ()))
        if name in known:
            found += [name] if unit == "1" and known[name] == TAKEN_FOR_DEGREES else []
        elif name not in told and (said or (unit == "1" and angles is None and is_angular(name))):
            note = _judged(data, name, q, said)
            found += [name] if note and not said and is_in_degrees(data, q) else []
            notes += [note] if note else []
    return _converted(data, found, notes)


def is_in_degrees(data: Trajectories, q: Tensor) -> bool:
    """Whether a coordinate, (N,), is an angle in degrees, and not in rad.

    Its motion is steadier where jumps lose turns of 360 than where they lose turns of
    2π: an angle in rad that is recorded often enough loses jumps alone, one in degrees its motion. Whole numbers beyond
    360 may be counts.
    """
    counts = float(q.abs().max()) > TURN["deg"] and bool((q == q.round()).all())
    return not counts and _unsteady(data, q, TURN["rad"]) > _unsteady(data, q, TURN["deg"])


def _unsteady(data: Trajectories, q: Tensor, turn: float) -> float:
    """Mean change from step to step over the mean step, where jumps lose their turns."""
    steps = data.steps()
    d = q[steps.index + 1] - q[steps.index]
    d = d - turn * torch.round(d / turn)
    return float(d.diff().abs().mean() / d.abs().mean().clamp_min(torch.finfo(d.dtype).tiny))


def _judged(data: Trajectories, name: str, q: Tensor, said: bool) -> str:
    """What is said of a coordinate without a unit, or `said` to be in rad, that reaches far; "" for nothing."""
    largest = float(q.abs().max())
    if largest <= TURN["rad"]:
        return ""
    reaches, certain = f"reaches {largest:.4g}", is_in_degrees(data, q)
    if said:
        why = f"warning: {name} {reaches} rad, and moves between samples as an angle in degrees"
        return f"{why}: --degrees {name} (degrees= in Python), if it is one" if certain else ""
    if certain:
        why = f"it has no unit, {reaches}, and moves too far between samples for an angle in rad"
        return f"warning: {name} is taken for degrees: {why}; else give --degrees none (degrees=() in Python)"
    ways = f"--degrees {name} (degrees= in Python), an angle in rad by --angles {name}"
    return f"warning: {name} {reaches} without a unit, and is taken for a length; an angle in degrees is said by {ways}"


def _converted(data: Trajectories, names: Collection[str], notes: Collection[str]) -> Trajectories:
    """The set with these coordinates, which are in degrees, in rad; the table says what they were taken for."""
    units = tuple(DEGREES[0] if name in names else unit for name, unit in zip(data.names, data.units, strict=True))
    angles = tuple(angle and name not in names for name, angle in zip(data.names, data.angles, strict=True))
    columns = tuple((name, role, TAKEN_FOR_DEGREES if name in names else unit) for name, role, unit in data.columns)
    told = replace(data, units=units, angles=angles, columns=columns, notes=(*data.notes, *notes))
    return in_radians_and_seconds(told)
