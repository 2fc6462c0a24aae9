"""What sensors read: of each coordinate y = zero + drift t + q / scale, so that q = scale · (y − zero − drift t)."""

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
    """`measured` by what a user says: zeros are in the units of the columns, degrees where the table has degrees."""
    read = [] if zeros is None else np.atleast_1d(zeros).tolist()
    rad = [math.pi / 180 if name in data.degrees and unit == "rad" else 1.0 for name, unit in
           zip(data.names, data.units, strict=True)]  # fmt: skip
    return measured(data, [float(zero) * rad[k % data.dof] for k, zero in enumerate(read)], scales)


def measured(
    data: Trajectories,  # readings, in the units of q
    zeros: Sequence[float] | None = (),  # n numbers; empty or None: 0
    scales: Sequence[float] | None = (),  # what one unit of each reading is worth, n numbers; empty or None: 1
    drifts: Sequence[float] = (),  # what the zeros gain in a unit of time since each recording began, n; empty: 0
) -> Trajectories:
    """The positions q = scale · (y − zero − drift t) of readings y, v likewise; p and s stay as they are recorded.

    B recordings may have B · n numbers, recording after recording. Raise InputError for another count of numbers, for a
    number that is not finite, or for a scale of 0.
    """
    read, worth = ([] if x is None else np.atleast_1d(x).tolist() for x in (zeros, scales))
    if drifts:
        rate = data.q.new_tensor(drifts)
        v = None if data.v is None else data.v - rate
        data = replace(data, q=data.q - since_start(data)[:, None] * rate, v=v)
    if not read and not worth:
        return data
    zero = _of_each_sample(data, "zeros", read or [0.0] * data.dof)
    scale = _of_each_sample(data, "scales", worth or [1.0] * data.dof)
    none = f"{data.source or 'data'}: a scale of 0 leaves no motion; give what one unit of the reading is worth"
    refuse({none: 0.0 in [float(x) for x in worth]})
    q = data.q - zero if read else data.q
    v = scale * data.v if worth and data.v is not None else data.v
    return replace(data, q=scale * q if worth else q, v=v)


def since_start(data: Trajectories) -> Tensor:
    """Time since the recording of each sample began, (N,)."""
    return data.t - data.t[list(data.offsets)][data.trajectory]


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
