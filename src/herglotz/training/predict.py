"""A trained model on a recording it has not seen: the first samples give the state, the rest is a free run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.actuator import acting
from herglotz.data.input_terms import input_terms_of, with_input_terms
from herglotz.data.sensors import measured
from herglotz.data.splits import leading, leading_rows
from herglotz.data.waves import with_waves
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper, state_of
from herglotz.stepping.velocity import velocities
from herglotz.threads import one_thread
from herglotz.training.cross_validation import MARGIN
from herglotz.training.fitted_run import FittedRun
from herglotz.training.free_run import free_runs
from herglotz.training.problems.grid import SegmentGrid, segment_grid, step_inputs
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.smoothing import SmoothingProblem
from herglotz.training.recorded_range import Beyond, farthest, quantities_outside
from herglotz.training.sensor_zeros import zeros_of_one
from herglotz.training.smoother import smoothed_states

WARMUP = 20  # samples from which the state is estimated
BELIEVED = 0.1  # noise of a radian of motion over that of the data, as of steps in `smooth`: states follow the model


@dataclass(frozen=True, repr=False)
class Prediction:
    """A recording beside the model's free run. With windows, each window is one trajectory of `data`."""

    data: Trajectories  # what was scored, angles unwrapped; every `every`-th sample of the recording
    states: State  # (N, n), (N, n), (N,) smoothed in the warm-up, then free; NaN from a failed step on
    warmup: int  # leading samples of each trajectory that the state was estimated from
    every: int  # stride by which the recording was thinned, so that its steps are not shorter than the model's
    most_substeps: int  # largest number of model steps in a recorded step
    outside: float  # share of model steps that are shorter or longer than those of the training data
    zeros: tuple[float, ...] = ()  # of the sensors, (n,), that were taken off the recording; empty: 0
    beyond: tuple[Beyond, ...] = ()  # what leaves the range of the fit, farthest first: the model extrapolates there
    v: Tensor | None = None  # (N, n) velocities of the states, in units of q over that of t

    def __repr__(self) -> str:
        rms = "failed" if self.rms is None else f"{self.rms:.3g}"
        return f"Prediction({', '.join(self.data.names)} of {self.data.source or 'data'}; RMS {rms})"

    @property
    def prediction(self) -> Tensor:
        """Positions of the model at every sample, (N, n)."""
        return self.states.q

    @property
    def train_lengths(self) -> tuple[int, ...]:
        """Samples of each trajectory that the model was shown: the warm-up."""
        return (self.warmup,) * len(self.data)

    @property
    def free(self) -> Tensor:
        """Whether a sample is in the free run, (N,) bool."""
        return ~leading(self.data.lengths, self.train_lengths)

    @property
    def failed_steps(self) -> float:
        """Share of the samples of the free run that it did not reach."""
        return 1.0 - float(torch.isfinite(self.states.q[self.free]).all(-1).double().mean())

    @property
    def rms_per_coordinate(self) -> tuple[float, ...] | None:
        """RMS error of each coordinate over the samples that the free run reached; None where it reached none."""
        error = (self.states.q - self.data.q)[self.free & self.data.complete]
        error = error[torch.isfinite(error).all(-1)]
        return tuple(error.square().mean(0).sqrt().tolist()) if len(error) else None

    @property
    def rms(self) -> float | None:
        """RMS error over all coordinates."""
        each = self.rms_per_coordinate
        return None if each is None else (sum(x * x for x in each) / len(each)) ** 0.5

    def motion(self) -> Trajectories | None:
        """The predicted motion as far as it was reached; None where no trajectory has three samples."""
        reached = torch.isfinite(torch.cat([self.states.q, self.states.p], -1)).all(-1)
        counts = [int(reached[a : a + k].sum()) for a, k in zip(self.data.offsets, self.data.lengths, strict=True)]
        counts = [k if k >= 3 else 0 for k in counts]
        if not any(counts):
            return None
        v = None if self.v is None else self.v.nan_to_num()
        q, p = self.states.q.nan_to_num(), self.states.p.nan_to_num()
        whole = replace(self.data, q=q, p=p, s=None, v=v, observed=None)
        return whole.rows(leading_rows(self.data.lengths, counts), tuple(filter(None, counts)))

    def metrics(self) -> dict[str, Any]:
        """The numbers, for JSON."""
        each = self.rms_per_coordinate
        return {
            "rms": self.rms,
            "rms_per_coordinate": None if each is None else dict(zip(self.data.names, each, strict=True)),
            "units": dict(zip(self.data.names, self.data.units, strict=True)),
            "failed_steps": self.failed_steps,
            "warmup": self.warmup,
            "trajectories": len(self.data),
            "predicted_samples": int(self.free.sum()),
            "every": self.every,
            "most_substeps": self.most_substeps,
            "steps_outside_training": self.outside,
            "zeros": dict(zip(self.data.names, self.zeros, strict=True)) if self.zeros else None,
            "beyond": [asdict(each) for each in self.beyond],
        }


@one_thread()
def predict(
    run: FittedRun,
    data: Trajectories,
    *,
    warmup: int = WARMUP,
    windows: int | None = None,
    horizon: float | None = None,
    same_zeros: bool = False,
) -> Prediction:
    """Score a run on another recording.

    The state at sample `warmup` of each trajectory is smoothed from the samples up to it, with the model held. From
    there the model steps alone, driven by the inputs of the recording. A recorded step that is longer than those of the
    training data is crossed in equal model steps; a recording sampled faster is thinned, its inputs averaged.

    Parameters
    ----------
    run
        The trained model.
    data
        Recordings of the same coordinates, in the same units, with inputs where the model takes them.
    warmup
        Number of samples K that the state is estimated from, at least 3.
    windows, horizon
        Score this many windows, spread evenly over the recording, of K samples and then a free run over the time
        `horizon`, instead of one free run to the end of each trajectory.
    same_zeros
        The sensors read what those of the run's reference read. False: where the recordings of the fit differ in it,
        the zeros that suit the warm-up best are taken off, the same for all of these trajectories: those of one of
        them, or what the warm-ups tell of the sensors by the model.

    Returns
    -------
    Prediction
        A free run that fails says so in `failed_steps`.

    Raises
    ------
    InputError
        If the coordinates, units or inputs are not those of the run, or a trajectory is too short.
    """
    if isinstance(warmup, bool) or not isinstance(warmup, int) or warmup < 3:
        raise InputError(f"warmup must be a whole number >= 3 (samples that the state is read from), got {warmup!r}")
    data = of_the_run(run, data).unwrapped().to(dtype=next(run.model.parameters()).dtype, device="cpu")
    data = measured(data, drifts=(run.metrics.get("plan") or {}).get("drifts") or ())
    low, high = run.h_range
    every = max(1, int(high / data.typical_step + 1e-6)) if data.typical_step < low else 1
    if every > 1:
        data = data.thinned(every)
    if windows is not None or horizon is not None:
        data = _windows(data, warmup, windows, horizon)
    _check_lengths(data, warmup, every)
    states, zeros = _started(run, data, warmup, [()] if same_zeros else zeros_of(run))
    data = measured(data, zeros)
    grid = _free_run(run.stepper, data, states, warmup, high)
    inside = torch.arange(grid.longest) < grid.end[:, None]
    h = grid.h[inside]
    outside = float(((h < low) | (h > high)).double().mean())
    most = int(torch.unique(grid.row[inside], return_counts=True)[1].max())
    model, x = run.model, state_of(states)
    # Where a recorded step is crossed in several, p is that of the last of them.
    step = run.h if most == 1 else float(h.median())
    v = velocities(model, x, torch.tensor(step))
    found = Prediction(data, x, warmup, every, most, outside, zeros, v=v)
    return replace(found, beyond=_beyond(run.box, found))


def _beyond(box: Mapping[str, Sequence[float]], found: Prediction) -> tuple[Beyond, ...]:
    """What the free runs leave the range of the fit by."""
    rows = [found.free.nonzero()[:, 0][found.data.trajectory[found.free] == b] for b in range(len(found.data))]
    return farthest(
        quantities_outside(box, found.data, found.data.t[r], found.states.q[r], found.states.p[r]) for r in rows
    )


def zeros_of(run: FittedRun) -> list[tuple[float, ...]]:
    """The zeros of the sensors in the recordings of the fit, each once, those of the reference first."""
    zeros, n = (run.metrics.get("plan") or {}).get("zeros") or (), run.data.dof
    every = dict.fromkeys(tuple(zeros[i : i + n]) for i in range(0, len(zeros), n))
    return [(), *(zero for zero in every if any(zero))]


def of_the_run(run: FittedRun, data: Trajectories) -> Trajectories:
    """The coordinates of the run among those of the data, by name; a single one may be called otherwise."""
    wanted, where = run.data, data.source or "data"
    if data.dof == wanted.dof == 1:
        at = [0]
    elif set(wanted.names) <= set(data.names):
        at = [data.names.index(name) for name in wanted.names]
    else:
        raise InputError(
            f"{where}: the coordinates are {', '.join(data.names)}; the run was fitted to {', '.join(wanted.names)}: "
            "rename the columns"
        )
    for i, name, unit in zip(at, wanted.names, wanted.units, strict=True):
        if "1" not in (data.units[i], unit) and data.units[i] != unit:
            raise InputError(f"{where}: {name} is in {data.units[i]}, the run was fitted in {unit}; convert the column")
    data = with_waves(data, run.config.frequencies)
    data = data if data.u is None else with_input_terms(data, input_terms_of(wanted.columns))
    u = data.u if run.model.inputs else None
    p, v, observed = (None if x is None else x[:, at] for x in (data.p, data.v, data.observed))
    called = {data.names[i]: name for i, name in zip(at, wanted.names, strict=True)}
    data = replace(
        data, q=data.q[:, at], p=p, v=v, u=u, observed=observed, names=wanted.names, units=wanted.units,
        angles=wanted.angles,
        columns=tuple((called.get(name, name), role, unit) for name, role, unit in data.columns),
    )  # fmt: skip
    return acting(data, run.arrival)  # other recordings that say nothing are like those of the fit


def _check_lengths(data: Trajectories, warmup: int, every: int) -> None:
    """Raise unless every trajectory goes on for two samples after its warm-up."""
    length = min(data.lengths)
    if length >= warmup + 2:
        return
    thinned = f", every {every} of the recording" if every > 1 else ""
    shorter = f"use --warmup {max(3, length // 2)} or a longer recording"
    raise InputError(
        f"{data.source or 'data'}: trajectory {data.lengths.index(length)} has {length} samples{thinned}; a warm-up of "
        f"{warmup} needs at least {warmup + 2}: {shorter if length >= 5 else 'leave it out, for none is short enough'}"
    )


def _windows(data: Trajectories, warmup: int, count: int | None, horizon: float | None) -> Trajectories:
    """`count` windows of `warmup` samples and the time `horizon` after them, spread evenly over all possible starts."""
    if count is None or horizon is None:
        raise InputError("windows and horizon go together: how many windows, and the time that each is predicted")
    if count < 1 or not 0 < horizon < float("inf"):
        raise InputError(f"windows must be >= 1 and horizon a time > 0, got {count} and {horizon:g}")
    found: list[tuple[int, int]] = []  # first row, and the row after the last
    for first, length in zip(data.offsets, data.lengths, strict=True):
        t = data.t[first : first + length]
        ends = torch.searchsorted(t, t[warmup - 1 :] + horizon * (1 + 1e-9), right=True).tolist()
        reach = (t[warmup - 1 :] + horizon * (1 - 1e-9) <= t[-1]).tolist()
        found += [(first + k, first + end) for k, (end, ok) in enumerate(zip(ends, reach, strict=True)) if ok]
    found = [(a, b) for a, b in found if b - a >= warmup + 2]
    if not found:
        raise InputError(
            f"{data.source or 'data'}: no trajectory holds {warmup} samples and a time of {horizon:g} after them (at "
            f"least two samples there); {_shorter(data, warmup, horizon)}"
        )
    chosen = torch.linspace(0, len(found) - 1, min(count, len(found))).round().long().tolist()
    spans = [found[k] for k in chosen]
    rows = torch.cat([torch.arange(a, b) for a, b in spans])
    return data.rows(rows, tuple(b - a for a, b in spans))


def _shorter(data: Trajectories, warmup: int, horizon: float) -> str:
    """The largest warm-up and the longest time that the recording has room for, as a remedy."""
    times = [data.t[a : a + k] for a, k in zip(data.offsets, data.lengths, strict=True)]
    most = max(min(int((t + horizon * (1 - 1e-9) <= t[-1]).sum()), len(t) - 2) for t in times)
    left = max((float(t[-1] - t[warmup - 1]) for t in times if len(t) >= warmup + 2), default=0.0)
    shortest = min(float((t[2:] - t[:-2]).min()) for t in times)
    words = [f"--warmup {most}"] if 3 <= most < warmup and horizon >= shortest else []
    if left > 0 and not shortest <= horizon <= left:
        digits = 10.0 ** (3 - math.floor(math.log10(left)))
        words.append(f"--horizon {math.floor(left * digits * (1 + 1e-9)) / digits:g}")
    return f"use {' or '.join(words)}" if words else "use a longer recording"


def _started(
    run: FittedRun, data: Trajectories, warmup: int, zeros: list[tuple[float, ...]]
) -> tuple[Tensor, tuple[float, ...]]:
    """States over the warm-ups, and the zeros that suit them best: one of these, or one with more of their own."""
    ways = [_warmed_up(run, measured(data, zero), warmup) for zero in zeros]
    best = min(range(len(ways)), key=lambda i: ways[i][1])
    if len(zeros) > 1 and any(own := _own_zeros(run, measured(data, zeros[best]), warmup)):
        both = tuple(a + b for a, b in zip(zeros[best] or (0.0,) * data.dof, own, strict=True))
        states, cost = _warmed_up(run, measured(data, both), warmup)
        if cost <= MARGIN**2 * ways[best][1]:  # the noise of steps hides much of what zeros do within a warm-up
            return states, both
    return ways[best][0], zeros[best]


def _warmed_up(run: FittedRun, data: Trajectories, warmup: int) -> tuple[Tensor, float]:
    """States (N, 2n+1), NaN beyond the warm-up of each trajectory, and how badly they suit it."""
    states = torch.full((data.samples, 2 * data.dof + 1), torch.nan, dtype=data.q.dtype)
    sigma, (every, parts) = _sigma(run), _warm_ups(data, warmup)
    freedom = FREEDOM if run.metrics.get("outliers") else None  # what the fit has met may come again
    together = _smoothed(run.model, parts, sigma, run.h_range[1], freedom)
    if together is not None:
        states[every.flatten()], cost = together
        return states, cost
    costs = []
    for rows in every:  # one of them at least has no step near it
        alone = _smoothed(run.model, data.rows(rows, (warmup,)), sigma, run.h_range[1], freedom)
        if alone is not None:
            states[rows] = alone[0]
            costs.append(alone[1])
    lost = len(every) - len(costs)  # each counts as the worst of the others
    return states, sum(costs) + lost * max(costs, default=math.inf)


def _warm_ups(data: Trajectories, warmup: int) -> tuple[Tensor, Trajectories]:
    """The rows of the first samples of every trajectory, (B, K), and these samples as recordings."""
    lengths = (warmup,) * len(data)
    rows = leading_rows(data.lengths, lengths)
    return rows.reshape(-1, warmup), data.rows(rows, lengths)


def _sigma(run: FittedRun) -> float:
    return run.metrics.get("sigma") or max(run.model.config.scale) * 1e-6


def _own_zeros(run: FittedRun, data: Trajectories, warmup: int) -> tuple[float, ...]:
    """What the warm-ups tell of zeros of the sensors that no recording of the fit had, (n,)."""
    return zeros_of_one(run.model, _warm_ups(data, warmup)[1], _sigma(run), run.h_range[1])


def _smoothed(
    model: ContactLagrangian, data: Trajectories, sigma: float, max_step: float, freedom: float | None
) -> tuple[Tensor, float] | None:
    """States at every sample of warm-ups, (N, 2n+1), the model held, and ½|r|²; None where it has no step near them."""
    turn = max_step * max(v / x for v, x in zip(model.config.speed, model.config.scale, strict=True))
    process = BELIEVED * min(1.0, turn) ** 0.5  # a random force adds as much in many short steps as in a long one
    grid = segment_grid(data, data.samples, max_step)
    problem = SmoothingProblem(model, data, grid, sigma=sigma, process=process, freedom=freedom)
    found = smoothed_states(problem)
    return None if found is None else (problem.states(found[0]), found[1])


def _free_run(stepper: Stepper, data: Trajectories, states: Tensor, warmup: int, max_step: float) -> SegmentGrid:
    """Fill in the states after the warm-up of every trajectory, all of them stepped as one batch; return the grid."""
    rows = (~leading(data.lengths, (warmup - 1,) * len(data))).nonzero()[:, 0]
    rest = data.rows(rows, tuple(length - warmup + 1 for length in data.lengths))
    grid = segment_grid(rest, rest.samples, max_step)
    inputs = step_inputs(stepper.L_d, rest, grid)  # type: ignore[arg-type]
    states[rows] = grid.at_samples(free_runs(stepper, rest, grid, states[rows[grid.start_sample]], inputs))
    return grid
