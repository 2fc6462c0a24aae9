"""Readings of sensors: y = zero + q / scale of each coordinate, so that q = scale · (y − zero)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from torch import Tensor

from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError, refuse


def measured(
    data: Trajectories,  # readings, in the units of their columns
    zeros: Sequence[float] | None = (),  # n numbers, in degrees where the table has degrees; empty or None: 0
    scales: Sequence[float] | None = (),  # position for a unit of each reading, n numbers; empty or None: 1
) -> Trajectories:
    """The positions q = scale · (y − zero) of readings y, and v = scale · ẏ; p and s stay as they are recorded.

    B recordings may have B · n numbers, recording after recording. Raise InputError for another count of numbers, for a
    number that is not finite, or for a scale of 0.
    """
    read, worth = ([] if x is None else np.atleast_1d(x).tolist() for x in (zeros, scales))
    if not read and not worth:
        return data
    zero = _of_each_sample(data, "zeros", read or [0.0] * data.dof)
    scale = _of_each_sample(data, "scales", worth or [1.0] * data.dof)
    none = f"{data.source or 'data'}: a scale of 0 leaves no motion; give what one unit of the reading is worth"
    refuse({none: bool((scale == 0).any())})
    turned = [name in data.degrees and unit == "rad" for name, unit in zip(data.names, data.units, strict=True)]
    q = data.q - zero * zero.new_tensor([math.pi / 180 if x else 1.0 for x in turned])
    return replace(data, q=scale * q, v=None if data.v is None else scale * data.v)


def _of_each_sample(data: Trajectories, what: str, numbers: Sequence[float]) -> Tensor:
    """(N, n) or (n,) from n numbers, or n for each recording."""
    n, count = data.dof, len(data)
    x = data.q.new_tensor([float(number) for number in numbers])
    where = f"{data.source or 'data'}: sensor {what}"
    if len(x) not in (n, count * n):
        every = f", or {count * n}, those of its {count} recordings one after the other" if count > 1 else ""
        raise InputError(f"{where}: give {n}, one for each of {', '.join(data.names)}{every}; got {len(x)}")
    bad = next((number for number in numbers if not math.isfinite(number)), None)
    if bad is not None:
        raise InputError(f"{where} must be finite numbers, got {bad}")
    return x if len(x) == n else x.reshape(count, n)[data.trajectory]
