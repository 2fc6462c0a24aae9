"""A periodic force of known frequency and unknown amplitude and phase: cos νt and sin νt as inputs.

f cos(νt + φ) = f cos φ · cos νt − f sin φ · sin νt is linear in two inputs, so that the learned map from inputs to
forces is the amplitude and the phase (f cos φ, −f sin φ). The time stands in the inputs: L_d is time-dependent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError


def waves(t: Tensor, frequencies: Sequence[float]) -> Tensor:
    """Return cos νt and sin νt of every angular frequency ν at the times t, (N,) → (N, 2m)."""
    angle = t[:, None] * torch.tensor(frequencies, dtype=t.dtype, device=t.device)
    return torch.stack([angle.cos(), angle.sin()], -1).flatten(1)


def with_waves(data: Trajectories, frequencies: Sequence[float]) -> Trajectories:
    """The data with waves of these frequencies (rad per unit of time) as inputs; unchanged without frequencies.

    Raise InputError if a frequency is not positive, beyond half the rate of the samples (π/h), or the data hold other
    inputs.
    """
    if not frequencies:
        return data
    where = data.source or "data"
    if not all(0 < x < float("inf") for x in frequencies):
        raise InputError(f"{where}: frequencies must be positive numbers, got {tuple(frequencies)}")
    fastest = math.pi / data.typical_step
    if max(frequencies) > fastest:
        raise InputError(
            f"{where}: samples {data.typical_step:.4g} apart show no angular frequency above {fastest:.4g}, got "
            f"{max(frequencies):g}; give it in rad per unit of time"
        )
    u = waves(data.t, frequencies)
    if data.u is not None and (data.u.shape != u.shape or not torch.allclose(data.u, u)):
        raise InputError(f"{where}: holds inputs u, and frequencies would be inputs, too; leave one of them out")
    names = [f"{wave}({x:g} t)" for x in frequencies for wave in ("cos", "sin")]
    columns = data.columns if data.u is not None else (*data.columns, *((name, "input", "") for name in names))
    return replace(data, u=u, hold="smooth", columns=columns)
