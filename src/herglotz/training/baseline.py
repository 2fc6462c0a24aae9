"""A first look at the data: sizes, a typical step and the baseline's starting values, by linear least squares."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.trajectories import GAP
from herglotz.errors import InputError


@dataclass(frozen=True)
class Baseline:
    """What the data look like, as plain numbers a `ModelConfig` can hold."""

    angles: tuple[bool, ...]
    scale: tuple[float, ...]  # largest |q|
    speed: tuple[float, ...]  # largest |q̇|
    stiffness: tuple[float, ...]
    tilt: tuple[float, ...]
    rate: float
    max_step: float  # longest model step
    low: Tensor  # (n,) lowest position
    high: Tensor  # (n,) highest


def estimate_baseline(data: Trajectories) -> Baseline:
    """Fit q̈ᵢ = −kᵢ sin qᵢ − bᵢ cos qᵢ − γ q̇ᵢ (angles) or −kᵢ qᵢ − bᵢ − γ q̇ᵢ to finite differences.

    Noise biases second differences, so these numbers only start a fit.

    Raises
    ------
    InputError
        If nothing moves.
    """
    max_step = GAP * data.typical_step  # longer ones are gaps: crossed in several model steps
    t = data.triples(max_step)
    if len(t) == 0:
        raise InputError(f"{data.source or 'data'}: no three samples in a row without a gap; record at equal steps")
    h0, h1 = t.h0[:, None], t.h1[:, None]
    v = (t.q2 - t.q0) / (h0 + h1)
    a = 2 * ((t.q2 - t.q1) / h1 - (t.q1 - t.q0) / h0) / (h0 + h1)
    n = data.dof
    columns = a.new_zeros(len(t), n, 2 * n + 1)
    for i, angle in enumerate(data.angles):
        columns[:, i, 2 * i] = -(t.q1[:, i].sin() if angle else t.q1[:, i])
        columns[:, i, 2 * i + 1] = -(t.q1[:, i].cos() if angle else torch.ones_like(t.q1[:, i]))
        columns[:, i, 2 * n] = -v[:, i]
    x = torch.linalg.lstsq(columns.reshape(-1, 2 * n + 1).cpu(), a.reshape(-1, 1).cpu()).solution[:, 0].tolist()
    scale = data.q.abs().amax(0).tolist()
    speed = [float(s) for s in v.abs().amax(0)]
    for name, moved in zip(data.names, speed, strict=True):
        if moved == 0:
            raise InputError(f"{data.source or 'data'}: coordinate '{name}' never moves; leave it out")
    # A rate from noisy differences can have either sign; start from a small damping of the right order.
    typical = min(v / s for v, s in zip(speed, scale, strict=True))
    rate = x[2 * n] if x[2 * n] > 1e-3 * typical else 1e-2 * typical
    return Baseline(
        angles=tuple(data.angles),
        scale=tuple(scale),
        speed=tuple(speed),
        stiffness=tuple(x[0 : 2 * n : 2]),
        tilt=tuple(x[1 : 2 * n : 2]),
        rate=rate,
        max_step=max_step,
        low=data.q.amin(0),
        high=data.q.amax(0),
    )
