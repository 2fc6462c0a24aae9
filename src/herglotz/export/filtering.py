"""`hz.filter`: estimates of states, velocities and chosen numbers of a model from the samples so far."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from herglotz.codegen.c_compiler import compiler
from herglotz.data import Trajectories
from herglotz.data.gaps import complete
from herglotz.errors import InputError, refuse
from herglotz.export.c_compile import compile_c
from herglotz.export.c_header import MAX_DERIVATIVES
from herglotz.export.exported import ExportedStepper
from herglotz.export.noise import input_at, momentum_at, noise_of, parts_of
from herglotz.models import ContactLagrangian
from herglotz.stepping import State
from herglotz.stepping.filter import Belief, KalmanFilter, Noise
from herglotz.training.fitted_run import FittedRun, as_recorded
from herglotz.training.predict import of_the_run
from herglotz.training.problems.grid import step_inputs


@dataclass(frozen=True)
class Filtered:
    """The estimates of a filter after each of N samples, in the units of the data and of the model.

    * theta: the estimated numbers, with their names in `names`
    * covariance: of q, p, s where the motion depends on s, and θ, F numbers in all
    * surprise: squared innovation over its variance, n on average; NaN at the first sample of a trajectory
    """

    t: Tensor  # (N,)
    state: State  # (N, n), (N, n), (N,)
    v: Tensor  # (N, n)
    theta: Tensor  # (N, K)
    names: list[str]
    covariance: Tensor  # (N, F, F)
    covariance_of_v: Tensor  # (N, n, n)
    surprise: Tensor  # (N,)


def filter(
    run: FittedRun,
    recording: Any,
    parameters: Mapping[str, tuple[float, float]] | None = None,
    noise: Noise | None = None,
    lag: int = 0,
) -> Filtered:
    """Follow a recording by an extended Kalman filter on the run's step: x = x⁻ + P_q (y − q)/S at each sample.

    With a `lag` the estimate of each sample also uses the `lag` samples after it, as far as the trajectory has them:
    fixed-lag smoothing.

    Each trajectory starts at its first two samples. A C header exported with `extras=["filter"]` has the same filter
    (`docs/c.md`).

    Parameters
    ----------
    run
        What `fit` returned.
    recording
        Positions of the same coordinates, in the same units, with inputs where the model takes them: anything that
        `fit` takes.
    parameters
        Numbers of the model that are estimated too: by name, the standard deviation at the start, and that of the
        number's random walk over a unit of time, in the number's own unit.
    noise
        Standard deviations in the units of the data; default: those of the fit (`noise_of`).
    lag
        Number of later samples that an estimate uses; the computing time grows with its square.

    Returns
    -------
    Filtered
        States, velocities and their covariance at every sample whose positions were all read, in the units of the data.

    Raises
    ------
    InputError
        If the recording has other coordinates than the run, has trajectories of fewer than two samples or of no more
        than the lag, or moves to where the model has no step; or a deviation is negative or not finite.
    """
    chosen = dict(parameters or {})
    for name, pair in chosen.items():
        if not (isinstance(pair, Sequence) and len(pair) == 2 and all(0 <= x < math.inf for x in pair)):
            raise InputError(f"parameters: {name} needs two finite numbers >= 0, (deviation, wander), got {pair}")
    refuse({f"filter takes a run, got {type(run).__name__}; load_run(folder) reads one": not hasattr(run, "model")})
    model = copy.deepcopy(run.model).double()
    data = of_the_run(run, as_recorded(run, recording))
    data = complete(data).unwrapped().to(dtype=torch.float64, device="cpu")
    # A recording without the model's inputs is refused.
    step_inputs(model, data)
    wander = tuple(each for _, each in chosen.values())
    kalman = KalmanFilter(model, noise or noise_of(run, wander), list(chosen), stepper=_compiled(model, list(chosen)))
    if len(kalman.names) != len(chosen):
        raise InputError(f"{', '.join(chosen)} stand for several numbers of the model; name each of them")
    std = torch.tensor([first for first, _ in chosen.values()], dtype=torch.float64)
    beliefs, surprises, steps, longest = [], [], [], run.h_range[1]
    _check_lengths(data, lag)
    for first, length in zip(data.offsets, data.lengths, strict=True):
        belief, surprise = _started(kalman, data, first, std), math.nan
        for row in range(first, first + length):
            h = float(data.t[row] - data.t[row - 1]) if row > first else float(data.t[row + 1] - data.t[row])
            if row > first:
                belief = kalman.remember(belief, lag) if lag else belief
                before = _predicted(kalman, data, belief, row, h, longest)
                belief, surprise = kalman.update(before, data.q[row])
            beliefs.append(kalman.smoothed(belief, 0))
            # The sample `lag` before this one; at the end of the trajectory all that are left.
            for back in range(1, lag + 1) if row + 1 == first + length else [lag] * (lag <= row - first):
                beliefs[row - back] = kalman.smoothed(belief, back)
            surprises.append(surprise)
            steps.append(min(h, longest))
    return _filtered(kalman, data, beliefs, surprises, steps)


def _check_lengths(data: Trajectories, lag: int) -> None:
    shortest = min(data.lengths)
    if shortest < 2:
        raise InputError(f"{data.source or 'data'}: a trajectory has {shortest} sample; a filter starts at two")
    if not (isinstance(lag, int) and 0 <= lag < shortest):
        raise InputError(
            f"lag must be a whole number from 0 to {shortest - 1}, as a trajectory has {shortest} samples, got {lag}"
        )


def _predicted(kalman: KalmanFilter, data: Trajectories, belief: Belief, row: int, h: float, longest: float) -> Belief:
    """The prediction of a row from the row before, by the fewest equal steps that are no longer than `longest`."""
    parts = parts_of(h, longest)
    for k in range(parts):
        part = torch.tensor((k + 0.5) / parts, dtype=torch.float64)
        belief = kalman.predict(belief, h / parts, input_at(kalman.model, data, row - 1, part))
    return belief


def _compiled(model: ContactLagrangian, names: list[str]) -> ExportedStepper | None:
    """The model in C, which takes a hundredth of the time; None without a compiler or for a model without C."""
    if model.dof > MAX_DERIVATIVES:
        return None
    with suppress(InputError):
        compiler()
        return compile_c(model, parameters=names)
    return None


def _filtered(
    kalman: KalmanFilter, data: Trajectories, beliefs: list[Belief], surprises: list[float], steps: list[float]
) -> Filtered:
    """The beliefs as tensors, with velocities at steps of the model."""
    states, thetas, covariances = (torch.stack(x) for x in zip(*(_flat(belief) for belief in beliefs), strict=True))
    scales = data.t.new_tensor([float(belief.scale) for belief in beliefs])
    n = kalman.n
    state = State(states[:, :n], states[:, n:-1], states[:, -1])
    u = data.u if kalman.model.inputs else None
    if kalman.names:
        # Each sample has a model with its own numbers.
        found = [
            kalman.velocity(belief, h, None if u is None else u[i])
            for i, (belief, h) in enumerate(zip(beliefs, steps, strict=True))
        ]
        v, spread = (torch.stack(x) for x in zip(*found, strict=True))
    else:
        v, spread = kalman.velocity(Belief(state, thetas, covariances, scale=scales), data.t.new_tensor(steps), u)
    surprise = data.t.new_tensor(surprises)
    return Filtered(data.t, state, v, thetas, kalman.names, scales[:, None, None] * covariances, spread, surprise)


def _flat(belief: Belief) -> tuple[Tensor, Tensor, Tensor]:
    q, p, s = belief.state
    return torch.cat([q, p, s[None]]), belief.theta, belief.covariance


def _started(kalman: KalmanFilter, data: Trajectories, row: int, std: Tensor) -> Belief:
    """The belief at the first sample, with the momentum FL⁻ of the first two: its standard deviation is m √2 σ/h."""
    n, q0, zero = kalman.n, data.q[row], torch.zeros((), dtype=torch.float64)
    p, by_q1 = momentum_at(kalman.model, data, row)
    own = q0.new_tensor(kalman.noise.position)
    spread = torch.cat([own, 2**0.5 * (by_q1.square() @ own.square()).sqrt(), zero.expand(kalman.kept - 2 * n), std])
    return kalman.start(State(q0, p, zero), spread)
