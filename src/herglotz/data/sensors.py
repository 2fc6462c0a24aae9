"""Sensors: a reading y = zero + drift t + q / scale of each coordinate q, so that q = scale · (y − zero − drift t)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from torch import Tensor

from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError, refuse


def calibrated(
    data: Trajectories, zeros: Sequence[float] | None = (), scales: Sequence[float] | None = ()
) -> Trajectories:
    """`measured` with a user's zeros, in the units of the columns: degrees where the table has degrees."""
    own = [] if zeros is None else np.atleast_1d(zeros).tolist()
    units = zip(data.names, data.units, strict=True)
    rad = [math.pi / 180 if name in data.degrees and unit == "rad" else 1.0 for name, unit in units]
    return measured(data, [float(zero) * rad[k % data.dof] for k, zero in enumerate(own)], scales)


def measured(
    data: Trajectories,
    zeros: Sequence[float] | None = (),
    scales: Sequence[float] | None = (),
    drifts: Sequence[float] = (),
) -> Trajectories:
    """The positions q = scale · (y − zero − drift t) of readings y, and their rates; p and s stay as recorded.

    t is the time since each recording began. Zeros, scales and drifts are n numbers each; empty or None: 0, 1 and 0. B
    recordings may have B · n zeros or scales, recording after recording. Raise InputError for another count of numbers,
    for a number that is not finite, or for a scale of 0.
    """
    zeros, scales = ([] if x is None else np.atleast_1d(x).tolist() for x in (zeros, scales))
    if drifts:
        rate = data.q.new_tensor(drifts)
        v = None if data.v is None else data.v - rate
        data = replace(data, q=data.q - since_start(data)[:, None] * rate, v=v)
    if zeros:
        data = replace(data, q=data.q - _of_each_sample(data, "zeros", zeros))
    if scales:
        scale = _of_each_sample(data, "scales", scales)
        none = f"{data.source or 'data'}: a scale of 0 leaves no motion; give the position for one unit of the reading"
        refuse({none: bool((scale == 0).any())})
        data = replace(data, q=scale * data.q, v=None if data.v is None else scale * data.v)
    return data


def since_start(data: Trajectories) -> Tensor:
    """Time since the recording of each sample began, (N,)."""
    return data.t - data.t[list(data.offsets)][data.trajectory]


def _of_each_sample(data: Trajectories, what: str, numbers: Sequence[float]) -> Tensor:
    """The user's numbers as (n,), or as (N, n) if every recording has its own n numbers."""
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
