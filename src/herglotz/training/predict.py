"""Predict a new recording with a trained model: a warm-up gives the state, a free run the rest."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from herglotz.choices import WARMUP
from herglotz.data import Trajectories
from herglotz.data.driving import acting
from herglotz.data.input_terms import input_terms_of, with_input_terms, with_waves
from herglotz.data.noise import AT_THE_NOISE, precisions
from herglotz.data.sensors import measured
from herglotz.data.splits import leading, leading_rows
from herglotz.errors import InputError, refuse
from herglotz.stepping import State, state_of
from herglotz.stepping.velocity import velocities
from herglotz.threads import one_thread
from herglotz.training.baseline import estimate_baseline
from herglotz.training.cross_validation import MARGIN
from herglotz.training.errors_of_runs import APART, EXACT_ENOUGH
from herglotz.training.fitted_run import FittedRun
from herglotz.training.free_run import run_on
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.smoothing import SmoothingProblem
from herglotz.training.recorded_range import Beyond, farthest, quantities_outside
from herglotz.training.sensor_zeros import zeros_of_one
from herglotz.training.smoother import process_noise, smoothed_states
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.trajectory_fit import fit_states
from herglotz.training.verdict import STATE_ITERATIONS


@dataclass(frozen=True, repr=False)
class Prediction:
    """A recording beside the model's free run. With windows, each window is one trajectory of `data`.

    `states` are smoothed in the `warmup` leading samples of each trajectory, then a free run; NaN after a failed step.
    `every` is the stride by which the recording was thinned, `most_substeps` the largest number of model steps in a
    recorded step, `outside` the share of model steps shorter or longer than those of the training data. `zeros` of the
    sensors were subtracted (empty: none), and whole `turns` added to the readings of each recording (empty: none).
    `beyond` lists what leaves the range of the fit, farthest first.
    """

    data: Trajectories
    states: State  # (N, n), (N, n), (N,)
    warmup: int
    every: int
    most_substeps: int
    outside: float
    zeros: tuple[float, ...] = ()  # (n,)
    beyond: tuple[Beyond, ...] = ()
    v: Tensor | None = None  # (N, n) velocities, in units of q over that of t
    turns: tuple[tuple[int, ...], ...] = ()  # (B, n)

    def __repr__(self) -> str:
        rms = "failed" if self.rms is None else f"{self.rms:.3g}"
        return f"Prediction({', '.join(self.data.names)} of {self.data.source or 'data'}; RMS {rms})"

    @property
    def prediction(self) -> Tensor:
        """Positions of the model at every sample, (N, n)."""
        return self.states.q

    @property
    def train_lengths(self) -> tuple[int, ...]:
        """Number of leading samples of each trajectory that the model saw: the warm-up."""
        return (self.warmup,) * len(self.data)

    @property
    def free(self) -> Tensor:
        """True at samples of the free run, (N,) bool."""
        return ~leading(self.data.lengths, self.train_lengths)

    @property
    def failed_steps(self) -> float:
        """Share of the samples after a failed step of the free run."""
        return 1.0 - float(torch.isfinite(self.states.q[self.free]).all(-1).double().mean())

    @property
    def rms_per_coordinate(self) -> tuple[float, ...] | None:
        """RMS error of each coordinate over the samples before a failed step; None if there is none."""
        error = (self.states.q - self.data.q)[self.free & self.data.complete]
        error = error[torch.isfinite(error).all(-1)]
        return tuple(error.square().mean(0).sqrt().tolist()) if len(error) else None

    @property
    def rms(self) -> float | None:
        """RMS error over all coordinates, as `rms_per_coordinate`."""
        each = self.rms_per_coordinate
        return None if each is None else (sum(x * x for x in each) / len(each)) ** 0.5

    def motion(self) -> Trajectories | None:
        """The predicted motion up to the first failed step; None if no trajectory has three samples."""
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
        """Plain numbers for JSON."""
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
            "turns": [list(each) for each in self.turns] or None,
            "beyond": [asdict(each) for each in self.beyond],
        }


@one_thread()
def predict(
    run: FittedRun,
    data: Trajectories,
    *,
    warmup: int | None = None,
    windows: int | None = None,
    horizon: float | None = None,
    same_zeros: bool = False,
) -> Prediction:
    """Score a run on another recording.

    The states of each warm-up are smoothed with the model fixed. From the last of these states the model steps alone,
    driven by the recorded inputs. A recorded step longer than the steps of the training data is divided into equal
    model steps; a recording that was sampled faster is thinned, its inputs averaged.

    Parameters
    ----------
    run
        The trained model.
    data
        Recordings of the same coordinates, in the same units, with inputs where the model takes them.
    warmup
        Number of samples K that the state is estimated from, at least 3; default 20, or half of the shortest recording
        if that has fewer than 22.
    windows, horizon
        Score this many windows, spread evenly over the recording, instead of one free run to the end of each
        trajectory. A window has K samples of warm-up and a free run over the time `horizon`.
    same_zeros
        True: the sensors read 0 where the model's coordinates are 0, and do not drift. False: if recordings of the fit
        differ in their zeros, the set that fits the warm-ups best is subtracted from all trajectories of the data; and
        so is the drift that the fit found.

    Returns
    -------
    Prediction
        `failed_steps` is above 0 if a free run fails.

    Raises
    ------
    InputError
        If the coordinates, units or inputs differ from those of the run, or a trajectory is too short.
    """
    refuse({
        f"warmup must be a whole number >= 3 (samples that the state is read from), got {warmup!r}":
            warmup is not None and (type(warmup) is not int or warmup < 3),
    })  # fmt: skip
    data = of_the_run(run, data).unwrapped().to(dtype=next(run.model.parameters()).dtype, device="cpu")
    drifts = () if same_zeros else (run.metrics.get("plan") or {}).get("drifts") or ()
    data = measured(data, drifts=drifts)
    low, high = run.h_range
    every = max(1, int(high / data.typical_step + 1e-6)) if data.typical_step < low else 1
    if every > 1:
        data = data.thinned(every)
    warmup = warmup or _usual(min(data.lengths))
    turns = whole_turns(run, data, warmup)
    shift = torch.tensor(turns).to(data.q) if turns else data.q.new_zeros(len(data), data.dof)
    data = replace(data, q=data.q + 2 * math.pi * shift[data.trajectory])
    if windows is not None or horizon is not None:
        data = _windows(data, warmup, windows, horizon)
    _check_lengths(data, warmup, every)
    states, zeros = _started(run, data, warmup, [()] if same_zeros else zeros_of(run))
    data = measured(data, zeros)
    grid = run_on(run.stepper, data, states, (warmup,) * len(data), high)
    # Every trajectory is longer than its warm-up.
    assert grid is not None
    h = grid.h[inside := torch.arange(grid.longest) < grid.end[:, None]]
    outside = float(((h < low) | (h > high)).double().mean())
    most = int(torch.unique(grid.row[inside], return_counts=True)[1].max())
    x = state_of(states)
    # p at a sample belongs to the last model step before the sample, which is shorter than the recorded step.
    v = velocities(run.model, x, torch.tensor(run.h if most == 1 else float(h.median())))
    rows = [(data.trajectory == b).nonzero()[:, 0] for b in range(len(data))]
    beyond = farthest(quantities_outside(run.box, data, data.t[r], x.q[r], x.p[r]) for r in rows)
    return Prediction(data, x, warmup, every, most, outside, zeros, beyond, v, turns)


def whole_turns(run: FittedRun, data: Trajectories, warmup: int) -> tuple[tuple[int, ...], ...]:
    """Whole turns to be added to the angles of each recording, (B, n); () for none.

    Where a fit found angles to be positions on a line, as of a spring, the turn in which a sensor that wraps begins is
    not in the recording. Of the turns that take a warm-up into the range of the fit, those are added whose states
    smoothed with the model cost least, if they clearly cost less than the states of the reading.
    """
    if (run.metrics.get("plan") or {}).get("turning", True) or min(data.lengths) < warmup:
        return ()
    low, high = run.data.q.amin(0), run.data.q.amax(0)
    found = [[0] * data.dof for _ in data]
    for one, turns in zip(data, found, strict=True):
        part = _warm_ups(one, warmup)[1]
        best = _warmed_up(run, part, warmup)[1]
        for i in (i for i, unit in enumerate(run.data.units) if unit == "rad"):
            x = part.q[:, i]
            first, last = float((low[i] - x.max()) / (2 * math.pi)), float((high[i] - x.min()) / (2 * math.pi))
            for k in range(math.ceil(first), math.floor(last) + 1):
                moved = replace(part, q=part.q + 2 * math.pi * torch.tensor([*turns[:i], k, *turns[i + 1 :]]).to(x))
                if k and MARGIN**2 * (cost := _warmed_up(run, moved, warmup)[1]) < best:
                    turns[i], best = k, cost
    return tuple(map(tuple, found)) if any(map(any, found)) else ()


def missed_from_best_start(run: FittedRun, data: Trajectories) -> tuple[float, ...] | None:
    """RMS misfit of each coordinate, in its units, by free runs whose start states are fitted to whole recordings.

    A warm-up tells a velocity to about σ √12 / (T √K), K samples over a time T, and a free run carries the error on.
    From no other start does the model miss less. `data` are those of a `Prediction`. None if the model
    follows only parts of the recordings.
    """
    base = estimate_baseline(data, substeps=run.decided.substeps)
    task = Task(data, base, replace(run.decided, iterations=STATE_ITERATIONS), Stages())
    found = fit_states(task, run.model, run.metrics.get("sigma") or task.exact)
    if found is None or found.problem.grid.segments > len(data):
        return None
    with torch.no_grad():
        missed = (found.problem.misfit(found.path) * data.balance)[data.complete]
    return tuple(missed.square().mean(0).sqrt().tolist())


def longer_warmup(found: Prediction, best: tuple[float, ...]) -> int | None:
    """The warm-up whose start would miss about what the `best` start does, if a coordinate is far from that; else None.

    The error of a velocity, σ √12 / (T √K), falls with K to the power 3/2. Half of the recording is left to predict.
    None where the best start misses the data by more than their noise: the model misses them, too.
    """
    spreads = found.data.q.std(0, correction=0).tolist()
    noise = (precisions(found.data).to(found.data.q) * found.data.balance).tolist()
    met = (x <= max(AT_THE_NOISE * own, EXACT_ENOUGH * size) for x, own, size in zip(best, noise, spreads, strict=True))
    if not all(met):
        return None
    each = zip(found.rms_per_coordinate or (), best, spreads, strict=False)
    ratio = max((error / least for error, least, size in each if error > EXACT_ENOUGH * size and least), default=0.0)
    count = min(math.ceil(found.warmup * ratio ** (2 / 3)), min(found.data.lengths) // 2)
    return count if ratio > APART and count > found.warmup else None


def zeros_of(run: FittedRun) -> list[tuple[float, ...]]:
    """The distinct zeros of the sensors in the recordings of the fit; first (), which are all 0."""
    zeros, n = (run.metrics.get("plan") or {}).get("zeros") or (), run.data.dof
    every = dict.fromkeys(tuple(zeros[i : i + n]) for i in range(0, len(zeros), n))
    return [(), *(zero for zero in every if any(zero))]


def of_the_run(run: FittedRun, data: Trajectories) -> Trajectories:
    """The data with the coordinates of the run, found by name; a single coordinate may have another name."""
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
    # Hold, delay and lag of the fit apply unless the recording states its own.
    return acting(data, run.arrival)


def _usual(length: int) -> int:
    """The warm-up of recordings of this length: at least two samples have to follow."""
    return WARMUP if length >= WARMUP + 2 else max(3, length // 2)


def _check_lengths(data: Trajectories, warmup: int, every: int) -> None:
    """Raise unless every trajectory has two samples after its warm-up."""
    length = min(data.lengths)
    shortest = data.label(data.lengths.index(length))
    thinned = f", every {every} of the recording" if every > 1 else ""
    remedy = "leave it out, as no warm-up is short enough"
    remedy = f"use --warmup {max(3, length // 2)} or a longer recording" if length >= 5 else remedy
    refuse({
        f"{data.source or 'data'}: {shortest} has {length} samples{thinned}; a warm-up of {warmup} needs at least "
        f"{warmup + 2}: {remedy}": length < warmup + 2,
    })  # fmt: skip


def _windows(data: Trajectories, warmup: int, count: int | None, horizon: float | None) -> Trajectories:
    """`count` windows of `warmup` samples and the time `horizon` after them, spread evenly over all possible starts."""
    if count is None or horizon is None:
        raise InputError("windows and horizon go together: how many windows, and the time that each is predicted")
    if count < 1 or not 0 < horizon < float("inf"):
        raise InputError(f"windows must be >= 1 and horizon a time > 0, got {count} and {horizon:g}")
    # First row of each window, and the row after its last.
    found: list[tuple[int, int]] = []
    for first, length in zip(data.offsets, data.lengths, strict=True):
        t = data.t[first : first + length]
        ends = torch.searchsorted(t, t[warmup - 1 :] + horizon * (1 + 1e-9), right=True).tolist()
        reach = (t[warmup - 1 :] + horizon * (1 - 1e-9) <= t[-1]).tolist()
        found += [
            (first + k, first + end)
            for k, (end, ok) in enumerate(zip(ends, reach, strict=True)) if ok and end - k >= warmup + 2
        ]  # fmt: skip
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
    """The remedy: the largest warm-up, or the longest horizon, that fits into the recording."""
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
    """States over the warm-ups, and the zeros of smallest cost: a candidate, or the best one plus a correction."""
    ways = [_warmed_up(run, measured(data, zero), warmup) for zero in zeros]
    best = min(range(len(ways)), key=lambda i: ways[i][1])
    own: tuple[float, ...] = ()
    if len(zeros) > 1:
        parts = _warm_ups(measured(data, zeros[best]), warmup)[1]
        own = zeros_of_one(run.model, parts, _sigma(run), run.h_range[1])
    if any(own):
        both = tuple(a + b for a, b in zip(zeros[best] or (0.0,) * data.dof, own, strict=True))
        states, cost = _warmed_up(run, measured(data, both), warmup)
        # The correction has to lower the cost clearly: process noise can absorb a wrong zero within a warm-up.
        if cost <= MARGIN**2 * ways[best][1]:
            return states, both
    return ways[best][0], zeros[best]


def _warmed_up(run: FittedRun, data: Trajectories, warmup: int) -> tuple[Tensor, float]:
    """States (N, 2n+1), NaN after the warm-up of each trajectory, and the cost ½|r|² of all warm-ups."""
    states = torch.full((data.samples, 2 * data.dof + 1), torch.nan, dtype=data.q.dtype)
    every, parts = _warm_ups(data, warmup)
    together = _smoothed(run, parts)
    if together is not None:
        states[every.flatten()], cost = together
        return states, cost
    # Smoothing failed in at least one warm-up. Each failure is given the largest cost of the others.
    costs = []
    for rows in every:
        alone = _smoothed(run, data.rows(rows, (warmup,)))
        if alone is not None:
            states[rows] = alone[0]
            costs.append(alone[1])
    return states, sum(costs) + (len(every) - len(costs)) * max(costs, default=math.inf)


def _warm_ups(data: Trajectories, warmup: int) -> tuple[Tensor, Trajectories]:
    """The rows of the first samples of every trajectory, (B, K), and these samples as recordings."""
    lengths = (warmup,) * len(data)
    rows = leading_rows(data.lengths, lengths)
    return rows.reshape(-1, warmup), data.rows(rows, lengths)


def _sigma(run: FittedRun) -> float:
    return run.metrics.get("sigma") or max(run.model.config.scale) * 1e-6


def _smoothed(run: FittedRun, data: Trajectories) -> tuple[Tensor, float] | None:
    """Smoothed states of warm-ups, (N, 2n+1), with the model fixed, and ½|r|²; None if a step near the data fails."""
    max_step = run.h_range[1]
    # If the training data had outliers, new recordings may have outliers too. The noise is that of the fit: a
    # coordinate that rests in a warm-up is measured no better for it.
    problem = SmoothingProblem(
        run.model, data, segment_grid(data, data.samples, max_step), process=process_noise(run.model, max_step),
        sigma=_sigma(run), freedom=FREEDOM if run.metrics.get("outliers") else None,
        balance=run.data.balance.to(data.q),
    )  # fmt: skip
    found = smoothed_states(problem)
    return None if found is None else (problem.states(found[0]), found[1])
