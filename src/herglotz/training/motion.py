"""`Run.rollout`: a free motion of the model as numpy arrays."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.driving import driven, even_times, input_recording
from herglotz.data.input_terms import waves
from herglotz.errors import InputError, check_start, check_whole
from herglotz.stepping import State
from herglotz.stepping.velocity import velocities
from herglotz.threads import one_thread
from herglotz.training.fitted_run import FittedRun
from herglotz.training.recorded_range import Beyond, other_steps, quantities_outside, warning

Numbers = float | Sequence | np.ndarray | Tensor


@dataclass(frozen=True, repr=False)
class Motion:
    """A motion of a model as numpy arrays: K + 1 samples with the start first. All values after a failed step are NaN.

    Parameters
    ----------
    t, q, v
        (K+1,) time; (..., K+1, n) position and velocity, in the units of the data and these over the unit of t. v is
        NaN if no velocity belongs to p (`Stepper.velocity`).
    p, s
        (..., K+1, n) momentum, for which the first mass is 1, and (..., K+1) action, in the units of `herglotz.State`.
    status
        (..., K) status of every step, 0 if it was solved (`herglotz.Status`), dimensionless.
    names, units, time_unit
        Names and units of the coordinates, and the unit of t.
    beyond
        Quantities that leave the range of the fit, where the model extrapolates.
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    p: np.ndarray
    s: np.ndarray
    status: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    time_unit: str
    beyond: tuple[Beyond, ...] = ()

    @property
    def ok(self) -> bool:
        """True if every step was solved."""
        return not self.status.any()

    def __repr__(self) -> str:
        failed = "" if self.ok else f", {int((self.status != 0).sum())} steps failed"
        names, shape = ", ".join(self.names), tuple(self.q.shape)
        left = f"; {warning(self.beyond, self.time_unit)}" if self.beyond else ""
        return f"Motion(t {self.t[0]:g} to {self.t[-1]:g} {self.time_unit}, q {shape} of {names}{failed}{left})"


@one_thread()
def free_motion(
    run: FittedRun,
    steps: int,
    *,
    q0: Numbers | None = None,
    v0: Numbers | None = None,
    p0: Numbers | None = None,
    s0: Numbers | None = None,
    t0: float | None = None,
    h: float | None = None,
    inputs: Any = None,
    trajectory: int = 0,
) -> Motion:
    """Step a run from its last fitted state, or from (q0, v0, s0) or (q0, p0, s0); see `Run.rollout`."""
    check_start(q0 is not None, v0 is not None, p0 is not None)
    check_whole(1, steps=steps)
    fitted, time = run.last_fitted(trajectory if q0 is None else 0)
    time = t0 if t0 is not None else time if q0 is None else 0.0
    dtype = fitted.q.dtype
    u, times = _inputs(run, inputs, (time, steps, h), (trajectory, q0 is not None and t0 is None))
    if words := other_steps(times, run.h_range, run.data.time_unit):
        warnings.warn(f"{words}; run.at_step(h) steps the same motion at another h", stacklevel=4)
    step: Any = times.diff().to(dtype) if isinstance(inputs, (str, Path, Trajectories)) else (h or run.h)
    h_of = torch.as_tensor(step, dtype=dtype).expand(steps)
    with torch.no_grad():
        state = fitted if q0 is None else _given(run, q0, (v0, p0), s0, h_of[0])
        found = run.stepper.rollout(*state, h=step, steps=steps, inputs=None if u is None else u.to(dtype))
        v = velocities(run.model, found.states, torch.cat([h_of[:1], h_of]))
    arrays = [x.detach().cpu().numpy() for x in (times, found.q, v, found.p, found.s, found.status)]
    left = tuple(quantities_outside(run.box, run.data, times, found.q, found.p))
    return Motion(*arrays, names=run.data.names, units=run.data.units, time_unit=run.data.time_unit, beyond=left)


def _given(
    run: FittedRun, q0: Numbers, moving: tuple[Numbers | None, Numbers | None], s0: Numbers | None, h: Tensor
) -> State:
    """The state from a position, and a velocity or a momentum."""
    like, n, name = run.last_fitted()[0].q, run.data.dof, "p0" if moving[0] is None else "v0"
    q, x = (torch.atleast_1d(torch.as_tensor(y, dtype=like.dtype)) for y in (q0, moving[name == "p0"]))
    if q.shape[-1] != n or x.shape != q.shape:
        raise InputError(
            f"q0 and {name} need {n} numbers each, one a coordinate; got {tuple(q.shape)}, {tuple(x.shape)}"
        )
    s = q.new_zeros(q.shape[:-1]) if s0 is None else torch.as_tensor(s0, dtype=like.dtype).expand(q.shape[:-1])
    return State(q, x, s) if name == "p0" else run.stepper.init_qv(q, x, s, h)


def _inputs(
    run: FittedRun, inputs: Any, span: tuple[float, int, float | None], recording: tuple[int, bool]
) -> tuple[Tensor | None, Tensor]:
    """Inputs (K, m) and times (K + 1,) of a rollout, from a recording, an array of steps, or constants."""
    (time, steps, h), (trajectory, from_first) = span, recording
    if isinstance(inputs, (str, Path, Trajectories)):
        found = input_recording(inputs, trajectory, run.data.time_unit, run.arrival, run.data.columns)
        return driven(found, float(found.t[0]) if from_first else time, steps, h)
    times = even_times(time, h or run.h, steps)
    if inputs is None:
        middle = 0.5 * (times[1:] + times[:-1])
        return waves(middle, run.config.frequencies) if run.config.frequencies else None, times
    u = torch.as_tensor(inputs, dtype=torch.float64)
    u = u.reshape(1) if u.ndim == 0 else u[:, None] if u.ndim == 1 and len(u) == steps else u
    return u.expand(steps, u.shape[-1]), times
