"""`hz.filter`: states, velocities and chosen numbers of a model from the samples so far; the noise levels of a fit."""

from __future__ import annotations

import copy
import ctypes
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from typing import Any

import torch
from torch import Tensor

from herglotz.codegen.c_compiler import build, compiler
from herglotz.data import Trajectories
from herglotz.data.gaps import complete
from herglotz.errors import InputError, refuse
from herglotz.export.c_header import MAX_DERIVATIVES, runtime
from herglotz.export.c_wrappers import header_of
from herglotz.export.exported import ExportedStepper
from herglotz.export.load import compile_c
from herglotz.mechanics import legendre_minus
from herglotz.mechanics.newton import find_root
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper
from herglotz.stepping.filter import Belief, KalmanFilter, Noise
from herglotz.stepping.linearise import forward_slopes
from herglotz.training.fitted_run import FittedRun, as_recorded
from herglotz.training.predict import of_the_run
from herglotz.training.problems.grid import segment_grid, step_inputs
from herglotz.training.problems.smoothing import SmoothingProblem
from herglotz.training.smoother import process_noise

# The scale of the noise is learned from about the last 50 samples. Windows of the measured UW double pendulum then have
# a mean surprise of 1.2 to 2.7, where 2 is right, and of 0.6 to 3.4 with a fixed scale (docs/c.md, measured).
ADAPTATION = 0.02


def noise_of(run: FittedRun, theta: tuple[float, ...] = ()) -> Noise:
    """The noise of positions and of unknown forces with the largest likelihood of the fit's data under the filter.

    Both minimise −2 log p = Σ (y_i − q_i)²/S_i + log S_i over the innovations of the run's own samples whose positions
    were all read. Beyond 8 coordinates and without a C compiler both are those that the fit itself assumes.

    Source: A. C. Harvey, Forecasting, structural time series models and the Kalman filter (1989), section 3.4.

    Parameters
    ----------
    run
        What `fit` returned.
    theta
        Standard deviations of the random walks of estimated numbers, for the result.

    Returns
    -------
    Noise
        Standard deviations in the units of the data, and `adaptation`, by which the filter learns their scale.

    Raise InputError if the fit found no noise.
    """
    problem, h = _problem(run), run.h
    n = problem.n
    momentum = problem.process * problem.mass * problem.deviations * problem.speed / problem.scale / math.sqrt(h)
    if not bool((problem.deviations[:n] > 0).all()):
        raise InputError("the run's metrics have no noise (sigma) > 0; give noise to the filter")
    levels = torch.cat([problem.deviations.expand(n), momentum.expand(n)]).double()
    if n <= MAX_DERIVATIVES and _compiles():
        # One descent starts at what the fit assumes, one at forces so large that the filter follows any motion.
        large = torch.cat([levels[:n], (problem.mass * problem.speed / math.sqrt(h)).expand(n).double()])
        cost = _likelihood(run)
        levels = min((_descended(cost, start.log()) for start in (levels, large)), key=cost).exp()
    return Noise(levels[:n].tolist(), levels[n:].tolist(), theta, ADAPTATION)


def input_at(model: ContactLagrangian, data: Trajectories, row: int, part: Tensor) -> Tensor | None:
    """The input (m,) at a part, 0 to 1, of the recorded step that starts at a row."""
    if not model.inputs:
        return None
    u = data.inputs_of_steps(torch.tensor([row]), part[None])
    # `step_inputs` has refused a recording without inputs.
    assert u is not None
    return u[0]


def momentum_at(model: ContactLagrangian, data: Trajectories, row: int, longest: float) -> tuple[Tensor, Tensor]:
    """The momentum (n,) with which the model moves to the next sample, and its derivative (n, n) by the next sample.

    FL⁻ of both samples is the momentum of a single step; it also counts where no motion of `parts_of` steps arrives.
    """
    q0, q1, h = data.q[row], data.q[row + 1], data.t[row + 1] - data.t[row]
    u = input_at(model, data, row, torch.tensor(0.5, dtype=torch.float64))
    zero = torch.zeros((), dtype=torch.float64)

    def momentum(q1: Tensor) -> Tensor:
        return legendre_minus(model if u is None else model.at(u), q0, q1, zero, h)[1]

    with torch.no_grad():
        p, by_q1 = momentum(q1), forward_slopes(momentum, q1)
    parts, stepper, n = parts_of(float(h), longest), Stepper(model), len(q0)

    def missed(p: Tensor) -> tuple[Tensor, Tensor]:
        """How far the motion with the momentum p ends from the next sample, and the derivative by p."""
        state, by_start = State(q0, p, zero), torch.eye(2 * n + 1, dtype=q0.dtype)
        for k in range(parts):
            u = input_at(model, data, row, torch.tensor((k + 0.5) / parts, dtype=torch.float64))
            found = stepper.linearise(state, h / parts, u)
            state, by_start = found.step.state, found.by_state @ by_start
        return state.q - q1, by_start[:n, n : 2 * n]

    if parts > 1 and bool((found := find_root(missed, p)).converged):
        return found.x, torch.linalg.inv(found.J)
    return p, by_q1


def parts_of(h: float, longest: float) -> int:
    """The number of equal steps in a recorded step h: the fewest that are no longer than `longest`."""
    return max(1, math.ceil(h / longest - 1e-6))


def _compiles() -> bool:
    try:
        compiler()
    except InputError:
        return False
    return True


def _likelihood(run: FittedRun) -> Callable[[Tensor], float]:
    """−2 log p of the run's data as a function of the logarithms of the levels (2n,); infinite where a step fails."""
    model = copy.deepcopy(run.model).double()
    data = complete(run.data).unwrapped().to(dtype=torch.float64, device="cpu")
    header = header_of(model, "noise", {"h": run.h, "extras": ["filter"]})
    library = build(header, re.sub(r"\bhz_", "noise_", runtime("innovations.c")))
    longest = run.h_range[1]
    parts, rows, places, steps = _parts(data, longest)
    starts, slopes = [], []
    for first in data.offsets:
        p, by_q = momentum_at(model, data, first, longest)
        starts.append(torch.cat([data.q[first], p]))
        slopes.append(by_q)
    zero = torch.zeros(1, dtype=torch.float64)
    u = data.inputs_of_steps(rows, places) if model.inputs else None
    lists = [torch.tensor(data.lengths), parts, steps, zero if u is None else u.contiguous(), data.q.contiguous()]
    lists += [torch.stack(starts), torch.stack(slopes)]

    def found(levels: Tensor) -> float:
        deviations, total = levels.exp().contiguous(), torch.zeros_like(zero)
        pointers = (ctypes.c_void_p(x.data_ptr()) for x in (*lists, deviations, total))
        failed = library.herglotz_likelihood(ctypes.c_long(len(data)), *pointers)
        return math.inf if failed or not math.isfinite(float(total)) else float(total)

    return found


def _parts(data: Trajectories, longest: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The model's steps: each recorded step is cut into the fewest equal steps that are no longer than `longest`.

    The number of model steps to each sample (N,); then of each model step the row at which its recorded step starts,
    the place of its middle in the recorded step, from 0 to 1, and its length, all (K,).
    """
    recorded = data.steps()
    counts = torch.tensor([parts_of(h, longest) for h in recorded.h.tolist()])
    parts = torch.zeros(data.samples, dtype=torch.int64).index_copy(0, recorded.index + 1, counts)
    rows, h, spread, before = (
        x.repeat_interleave(counts) for x in (recorded.index, recorded.h, counts, counts.cumsum(0) - counts)
    )
    places = (torch.arange(len(spread)).double() - before + 0.5) / spread
    return parts, rows, places, h / spread


def _descended(cost: Callable[[Tensor], float], x: Tensor) -> Tensor:
    """The minimum of a function of logarithms by coordinate descent, to a step of 0.1: a tenth of a level is enough."""
    best, step = cost(x), 1.0
    while step > 0.1:
        moved = False
        for i in reversed(range(len(x))):
            for move in (-step, step):
                while (found := cost(other := x + move * torch.eye(len(x), dtype=x.dtype)[i])) < best:
                    best, x, moved = found, other, True
        step = step if moved else step / 2
    return x


def _problem(run: FittedRun) -> SmoothingProblem:
    """The smoothing problem of the run's own data, which holds the noise that the fit assumes."""
    data, high = run.data.unwrapped(), run.h_range[1]
    process = run.metrics.get("process") or process_noise(run.model, run.h)
    sigma = run.metrics.get("sigma") or 0.0
    return SmoothingProblem(run.model, data, segment_grid(data, data.samples, high), sigma=sigma, process=process)


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

    Each trajectory starts at its first two samples, with the momentum that moves the model from one to the other. A C
    header exported with `extras=["filter"]` has the same filter (`docs/c.md`).

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
    _check_lengths(data, lag)
    longest = run.h_range[1]
    rows = [
        _followed(kalman, data, first, length, std, longest, lag)
        for first, length in zip(data.offsets, data.lengths, strict=True)
    ]
    return _filtered(kalman, data, *(list(chain(*column)) for column in zip(*rows, strict=True)))


def _followed(
    kalman: KalmanFilter, data: Trajectories, first: int, length: int, std: Tensor, longest: float, lag: int
) -> tuple[list[Belief], list[float], list[float]]:  # fmt: skip
    """The beliefs, surprises and steps of one trajectory, which starts at row `first`."""
    h = float(data.t[first + 1] - data.t[first])
    belief = _started(kalman, data, first, std, longest)
    beliefs, surprises, steps = [kalman.smoothed(belief, 0)], [math.nan], [min(h, longest)]
    for k in range(1, length):
        h = float(data.t[first + k] - data.t[first + k - 1])
        belief = kalman.remember(belief, lag) if lag else belief
        belief, surprise = kalman.update(_predicted(kalman, data, belief, first + k, h, longest), data.q[first + k])
        beliefs.append(kalman.smoothed(belief, 0))
        # The sample `lag` before this one; at the end of the trajectory all that are left.
        for back in range(1, lag + 1) if k + 1 == length else [lag] * (lag <= k):
            beliefs[k - back] = kalman.smoothed(belief, back)
        surprises.append(surprise)
        steps.append(min(h, longest))
    return beliefs, surprises, steps


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


def _started(kalman: KalmanFilter, data: Trajectories, row: int, std: Tensor, longest: float) -> Belief:
    """The belief at the first sample, with the momentum of the first two: its standard deviation is m √2 σ/h."""
    n, q0, zero = kalman.n, data.q[row], torch.zeros((), dtype=torch.float64)
    p, by_q1 = momentum_at(kalman.model, data, row, longest)
    own = q0.new_tensor(kalman.noise.position)
    spread = torch.cat([own, 2**0.5 * (by_q1.square() @ own.square()).sqrt(), zero.expand(kalman.kept - 2 * n), std])
    return kalman.start(State(q0, p, zero), spread)
