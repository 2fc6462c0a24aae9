"""`evaluate`: the states of a fit at every sample, with a free run over the unseen part, and their errors."""

from __future__ import annotations

import math
import platform
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import herglotz
from herglotz.data import Trajectories
from herglotz.data.noise import spikes
from herglotz.data.splits import held_out_whole, leading, leading_rows
from herglotz.stepping import State, Stepper, state_of
from herglotz.training.config import FitConfig
from herglotz.training.free_run import states_everywhere
from herglotz.training.look import Look
from herglotz.training.objectives import Fitted
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.plan import Plan
from herglotz.training.problems.grid import step_inputs
from herglotz.training.problems.one_step import ResidualProblem, SupervisedProblem
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.recorded_range import box_of, near_recorded
from herglotz.training.run import Run
from herglotz.training.task import Task
from herglotz.training.verdict import judged, with_own_starts

# Multiple of the spread. A free run with a larger error has diverged, whatever the uncertainty of its start.
DIVERGED = 1e3


def evaluate(task: Task, seen: Look, plan: Plan | None, fitted: Fitted, told: FitConfig) -> Run:
    """The finished run: states, free run after the training part, and the errors of both.

    `told` are the user's settings, without the decisions of the plan.
    """
    train, data, config = seen.train, seen.data, task.config
    fitted = replace(fitted, states=_with_dropped(fitted, train, seen.spikes))
    fitted = replace(fitted, states=_with_starts(task, seen, fitted))
    dropped = seen.spikes.clone()
    if fitted.used is not None:
        dropped[~dropped] = ~fitted.used
    states, status = states_everywhere(fitted, data, train.lengths, task.base.model_step)
    metrics, free = _errors(fitted, task, seen, dropped, states)
    if free is not None and (metrics["extrapolation_rms"] or 0.0) > DIVERGED * metrics["spread"]:
        missed = f"it misses them by {metrics['extrapolation_rms'] / metrics['spread']:.1g} times their spread"
        status = f"the free run over the unseen samples leaves the world: {missed}"
        free, metrics["extrapolation_rms"] = torch.full_like(free, torch.inf), None
    metrics |= judged(task, seen, fitted, states.joined, free, metrics)
    # If a model follows no data, its states are the recorded ones, and have no error.
    if metrics["train_rms"] == 0.0:
        metrics["train_rms"] = metrics["window_rms"]
    metrics |= {
        "extrapolation_status": status,
        "outlier_samples": leading_rows(data.lengths, train.lengths)[dropped.cpu()].tolist(),
        "seed": config.seed,
        "level": config.level,
        **({} if plan is None else {"plan": plan.to_dict()}),
        "data": {"source": data.source, "sha256": data.digest(), "trajectories": len(data), "samples": data.samples},
        "versions": {module.__name__: module.__version__ for module in (herglotz, torch, np)}
        | {"python": platform.python_version()},
    }
    h = train.typical_step / config.substeps
    # Posterior, report and export are made on the CPU, also of a run that is loaded.
    model, data, states = fitted.model.cpu(), data.to(device="cpu"), state_of(states.joined.cpu())
    box = box_of(*state_of(near_recorded(fitted.states, train).cpu()))
    return Run(model, told, metrics, data, train.lengths, states, h, box, task.stages.history)


def unseen_errors(run: Run) -> list[Tensor]:
    """Errors of the free run at the complete unseen samples of each trajectory, (K, n); K may be 0."""
    error, complete = run.prediction.detach() - run.data.unwrapped().q, run.data.complete
    rows = zip(run.data.offsets, run.data.lengths, run.train_lengths, strict=True)
    spans = (slice(first + trained, first + length) for first, length, trained in rows)
    return [error[span][complete[span]] for span in spans]


def _with_dropped(fitted: Fitted, train: Trajectories, dropped: Tensor) -> Tensor:
    """States at all training samples; the states of samples left out of the fit are stepped from the sample before."""
    u, out = step_inputs(fitted.model, train), fitted.states.new_empty(train.samples, 2 * train.dof + 1)
    out[~dropped] = fitted.states
    # The first sample of a trajectory is never left out.
    rows = dropped.nonzero()[:, 0]
    for run in rows.tensor_split((rows.diff() > 1).nonzero()[:, 0] + 1) if len(rows) else ():
        before = run - 1
        inputs, h = None if u is None else u[before], train.t[run] - train.t[before]
        with torch.no_grad():
            found = Stepper(fitted.model).rollout(*state_of(out[run[0] - 1]), h=h, inputs=inputs)
        out[run] = found.states.joined[1:]
    return out


def _with_starts(task: Task, seen: Look, fitted: Fitted) -> Tensor:
    """States at all training samples; those of trajectories that are held out whole start where their samples say.

    Three noisy samples tell no velocity. All samples of such a trajectory tell its start, and nothing else of the fit.
    """
    whole = held_out_whole(seen.data.lengths, task.config.train_fraction)
    held = [b for b, out in enumerate(whole) if out]
    if not held:
        return fitted.states
    data = seen.data.select(held)
    own = with_own_starts(task, fitted, data, FREEDOM if task.config.robust != "off" else None)
    if own is None:
        return fitted.states
    first = leading_rows(data.lengths, [seen.train.lengths[b] for b in held])
    at, states = torch.tensor(whole)[seen.train.trajectory.cpu()], fitted.states.clone()
    states[at] = own.problem.grid.at_samples(own.path.x)[first]
    return states


def _errors(
    fitted: Fitted, task: Task, seen: Look, dropped: Tensor, states: State
) -> tuple[dict[str, Any], Tensor | None]:
    """RMS errors in units of q, None if not measurable, and the errors of the free run at unseen samples, (M, n)."""
    data, train, base, robust = seen.data, seen.train, task.base, task.config.robust != "off"
    training = leading(data.lengths, train.lengths).to(data.t.device)
    error, unit = states.q - data.q, fitted.notes.get("unit_of_s")
    used, beyond = training.clone(), ~training
    used[training] = ~dropped
    used, beyond = used & data.complete, beyond & data.complete
    if robust:
        beyond &= ~spikes(data)
    unseen = seen.unseen or data
    triples = unseen.triples(base.max_step)
    problem = ResidualProblem(fitted.model, unseen, max_step=base.max_step)
    x = problem.start()
    if unit is not None:
        problem = SupervisedProblem(fitted.model, unseen, momenta=False, max_step=base.max_step)
        x = torch.cat([x[: problem.P], x.new_tensor([unit]).log()])
    ratio = (triples.h1 / triples.h0)[:, None]
    unmoved = triples.q2 - triples.q1 - ratio * (triples.q1 - triples.q0)
    # True if every recorded step is a model step.
    stepped = len(triples) and base.model_step == base.max_step
    rate = getattr(fitted.model.damping, "rate", None)
    free = error[beyond] if seen.unseen is not None and bool(beyond.any()) else None
    numbers = {
        "one_step_rms": _rms(problem.residuals(x)) if stepped else None,
        "one_step_rms_constant_velocity": _rms(unmoved) if len(triples) else None,
        "train_rms": _rms(error[used]),
        "outliers": int(dropped.sum()),
        "outliers_unseen": int((~training & data.complete).sum() - beyond.sum()),
        "extrapolation_rms": None if free is None else _rms(free),
        "gain_over_mean": None if free is None else _gain(free, (data.q - data.q[used].mean(0))[beyond]),
        "spread": _rms(data.q - data.q.mean(0)),
        "objective": fitted.objective,
        "sigma": fitted.sigma,
        "rate": None if rate is None else float(rate.detach()),
        "parameters": len(ParameterVector(fitted.model).numbers),
        **fitted.notes,
    }
    return numbers, free


def _gain(free: Tensor, still: Tensor) -> float | None:
    """Gain of the free run over the mean of the training part as a prediction of unseen samples, in standard errors.

    None if the free run fails, or its squares overflow.
    """
    scale = still.square().mean(0).clamp_min(torch.finfo(still.dtype).tiny)
    gain = ((still.square() - free.square()) / scale).flatten()
    found = float(gain.mean() / (gain.std() / len(gain) ** 0.5).clamp_min(torch.finfo(gain.dtype).tiny))
    return found if math.isfinite(found) else None


def _rms(x: Tensor) -> float | None:
    value = float(x.detach().square().mean().sqrt())
    return value if np.isfinite(value) else None
