"""Conversion of degrees to radians and back, and of times to seconds; lengths, angles and ranges in words."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace

from torch import Tensor

from herglotz.data.trajectories import DEGREES, Trajectories

# How many of each unit of time make a second.
PER_SECOND = {
    "ms": 1e3, "us": 1e6, "µs": 1e6, "μs": 1e6, "ns": 1e9, "min": 1 / 60, "h": 1 / 3600,
    "sec": 1.0, "seconds": 1.0, "msec": 1e3, "usec": 1e6,
}  # fmt: skip


def in_radians_and_seconds(data: Trajectories) -> Trajectories:
    """Return the set with coordinates in degrees as angles in rad, and a time in ms, µs, ns, min or h in s."""
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
