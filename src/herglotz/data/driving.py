"""Times and inputs of a rollout: recorded inputs act at the times at which they were recorded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from herglotz.data.actuator import acting
from herglotz.data.holds import UNSPECIFIED, Arrival
from herglotz.data.input_terms import input_terms_of, with_input_terms
from herglotz.data.readers import load
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError, refuse

if TYPE_CHECKING:
    from torch import Tensor

# A start within this part of a step of a recorded time is at that time.
START_TOLERANCE = 1e-3


def clean(values: Tensor) -> Tensor:
    """Numbers rounded to 14 digits, so that 0.1 + 0.2 prints as 0.3."""
    return torch.tensor([float(f"{x:.14g}") for x in values.double().tolist()], dtype=torch.float64)


def even_times(t0: float, h: float, steps: int) -> Tensor:
    """The times of K equal steps from t0, (K + 1,)."""
    return clean(t0 + float(f"{h:.12g}") * torch.arange(steps + 1, dtype=torch.float64))


def input_recording(
    path: str | Path | Trajectories,
    trajectory: int,
    time_unit: str,
    default: Arrival = UNSPECIFIED,
    known: Sequence[Sequence[str]] = (),
) -> Trajectories:
    """The recording whose inputs drive the model: the trajectory of that number, or the only trajectory.

    A file needs times and inputs alone; `known` are the columns of the fit: name, role, unit. The returned inputs are
    the acting inputs, by the file's own hold, delay and lag, or else by `default`. Raise InputError if the file holds
    no inputs, has no such trajectory, or counts time in another unit.
    """
    found = path if isinstance(path, Trajectories) else load(path, known=tuple(map(tuple, known)), motion=False)
    path = found.source or "recording"
    found = acting(found if found.u is None else with_input_terms(found, input_terms_of(known)), default)
    trajectory = 0 if len(found) == 1 else trajectory
    count, unit = len(found), found.time_unit
    refuse({
        f"inputs {path}: holds no inputs; name their columns u, u_*, force or torque": found.u is None,
        f"inputs {path}: time is in {unit}, the model's in {time_unit}; convert it": unit != time_unit,
        f"inputs {path}: there is no trajectory {trajectory}; choose one from 0 to {count - 1}": trajectory >= count,
    })  # fmt: skip
    return found[trajectory]


def driven(found: Trajectories, t0: float, steps: int, h: float | None) -> tuple[Tensor, Tensor]:
    """Inputs (K, m) and times (K + 1,) of K steps from t0: the recording's own steps, or steps of h.

    A recorded step takes the input of its hold; a step of h takes the mean input over its time. Raise InputError if the
    recording does not cover these steps, or if recorded steps are taken and no sample is at t0.
    """
    t, u = found.t.double(), found.inputs_of_steps()
    # `input_recording` has refused recordings without inputs.
    assert u is not None
    where, spans = f"inputs {found.source}", f"the recording spans {float(t[0]):g} to {float(t[-1]):g}"
    if h is None:
        row = int((t - t0).abs().argmin())
        if abs(float(t[row]) - t0) > START_TOLERANCE * found.typical_step:
            remedy = "give t0 (--t0), or h (--h) for equal steps"
            raise InputError(f"{where}: no sample at the start t = {t0:g}; {spans}: {remedy}")
        if row + steps >= len(t):
            raise InputError(f"{where}: {steps} steps from t = {t0:g} need {row + steps + 1} samples, it has {len(t)}")
        return u[row : row + steps], t[row : row + steps + 1]
    times = even_times(t0, h, steps)
    slack = START_TOLERANCE * h
    if float(times[0]) < float(t[0]) - slack or float(times[-1]) > float(t[-1]) + slack:
        raise InputError(f"{where}: the rollout lasts from {t0:g} to {float(times[-1]):g}, but {spans}; give t0 (--t0)")
    total = torch.cat([torch.zeros_like(u[:1]), (u[:-1] * t.diff()[:, None]).cumsum(0)])
    at = torch.searchsorted(t, times).clamp(1, len(t) - 1)
    # ∫u grows linearly from the last sample before each time.
    passed = (times - t[at - 1])[:, None]
    integral = total[at - 1] + u[at - 1] * passed
    return integral.diff(dim=0) / times.diff()[:, None], times
