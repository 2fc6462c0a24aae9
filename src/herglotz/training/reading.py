"""How a fit was told to read its data: stored in config.json beside the settings, so that `--config` repeats it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypedDict, get_type_hints

import numpy as np

from herglotz.errors import refuse
from herglotz.schema import check_entries, matches

REMEDY = "fit again, or restore the folder as `herglotz fit` wrote it"


class Reading(TypedDict, total=False):
    """Options of `herglotz.data.load` by their names, then what `herglotz fit` makes of the recording."""

    time: str
    group: str
    coordinates: str | list[str]
    inputs: str | list[str]
    drop: str | list[str]
    angles: str | list[str]
    sensor_zeros: list[float]
    sensor_scales: list[float]
    hold: Literal["zero", "first", "smooth"]
    every: int


def reading_in(settings: dict[str, Any], where: str) -> dict[str, Any]:
    """Take what config.json says of reading the data out of its settings; {} where the user said nothing.

    Raises
    ------
    InputError
        If an entry is not known, or of another type than the flag of its name.
    """
    reading = settings.pop("reading", {})
    check_entries(Reading, reading, f"{where}: reading", REMEDY)
    unknown = ", ".join(sorted(set(reading) - set(Reading.__annotations__)))
    refuse({f"{where}: reading has no {unknown}; {REMEDY}": unknown})
    return reading


def reading_told(options: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """The options of `as_trajectories` that a file could be read with: names and numbers, no arrays of times.

    `names` are the coordinates that were read: those that `angles=True` means.
    """
    plain = {name: list(x) if np.ndim(x) == 1 else x for name, x in options.items()}
    if isinstance(angles := plain.get("angles"), bool):
        plain["angles"] = list(names) if angles else []
    for sensor in {"sensor_zeros", "sensor_scales"} & plain.keys():
        plain[sensor] = [float(x) for x in np.atleast_1d(plain[sensor])]
    return {name: plain[name] for name, hint in get_type_hints(Reading).items() if matches(plain.get(name), hint)}
