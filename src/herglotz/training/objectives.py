"""The three objectives of a plan: one-step errors, whole trajectories, and smoothing."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from herglotz.data.noise import precision
from herglotz.models import ContactLagrangian
from herglotz.training.distillation import taught
from herglotz.training.first_states import states_of_pairs
from herglotz.training.look import PROBE, Look
from herglotz.training.one_step_fit import NOISE_OF_R, best_restart, fit_one_step, one_step_problem
from herglotz.training.plan import Plan
from herglotz.training.problems.one_step import OneStep
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.smoother import fit_smoothing, weakest
from herglotz.training.task import Task, drag_starts_the_fit, with_sticking
from herglotz.training.trajectory_fit import Chosen, fit_states, fit_trajectories

# σ of the short fits that others start from, relative to the motion's size: these fits must not follow noise.
LOOSE = 0.02


@dataclass(frozen=True)
class Fitted:
    """The result of an objective, for `evaluate`."""

    model: ContactLagrangian
    states: Tensor  # (N_train, 2n+1) states at the training samples
    objective: str
    sigma: float
    notes: dict[str, Any]
    used: Tensor | None = None  # (N_train,) samples that were not found to be outliers; None: all


def fit_by_one_step(task: Task, seen: Look, plan: Plan) -> Fitted:
    """Minimise one-step errors, then fit the states: a free run must not start from two noisy samples."""
    raw = plan.objective == "raw"
    known_s: Tensor | None = None

    def problem(model: ContactLagrangian) -> OneStep:
        return one_step_problem(
            task, model, task.exact, metric="raw" if raw else "position", expected=seen.baseline_motion, s=known_s
        )

    iterations = task.config.iterations
    if plan.restarts > 1 or plan.network == "covered":
        model, iterations = best_restart(task, plan.network, plan.restarts, problem)
    else:
        model = task.build(plan.network) if seen.probe is None else seen.probe.model
        if (start := taught(task, plan.network, outliers=plan.outliers)) is not None:
            plain, known_s = problem(model), start.s
            other = problem(start.model)
            better = float(other.cost(other.start())) < float(plain.cost(plain.start()))
            model, known_s = (start.model, start.s) if better else (model, None)
    result, rms = fit_one_step(task, problem(model), "one-step error", iterations)
    noise = task.exact if raw else max(rms / NOISE_OF_R, task.exact)
    notes: dict[str, Any] = {"iterations": result.iterations, "reason": result.reason}
    if seen.baseline_motion is not None:
        notes["baseline_error"] = seen.baseline_motion[1]
    s = None
    if task.config.supervision != "q":
        assert task.data.s is not None
        notes["unit_of_s"] = unit = float(result.x[-1].exp())
        s = task.data.s / unit
    found = fit_states(task, model, noise, s)
    notes["follows_data"] = found is not None
    states = states_of_pairs(model, task.data) if found is None else found.states()
    return Fitted(model, states, "raw" if raw else "residual", noise, notes)


def fit_by_trajectory(task: Task, seen: Look, plan: Plan) -> Fitted:  # noqa: ARG001
    """Fit parameters and states to whole trajectories, from a short one-step fit or from values that were found."""
    task = replace(task, longest=plan.longest)
    found = model = None
    if not plan.fitted_before and (start := taught(task, plan.network, outliers=plan.outliers)) is not None:
        # The weakest prior comes first: what networks were taught is no departure to begin without.
        weakest_first = tuple(sorted(task.config.departures, reverse=True))
        weak = replace(task, config=replace(task.config, departures=weakest_first))
        model, sigma = start.model, plan.sigma or precision(task.data)
        found = fit_trajectories(weak, model, sigma, known=True)
    # The affine level has a linear start of its own, from which some motions are followed better.
    if model is None or drag_starts_the_fit(task.config):
        other, sigma = (
            (task.build(plan.network), plan.sigma or 0.0) if plan.fitted_before else _one_step_start(task, plan)
        )
        if task.config.sticking:
            other = with_sticking(other, excess=not plan.fitted_before)
        again = fit_trajectories(task, other, sigma, known=plan.fitted_before)
        if model is None or _missed(again) < _missed(found):
            found, model = again, other
    # A model that is lost keeps the parameters of the one-step fit.
    if found is None:
        return _lost(task, model, "trajectory", sigma, "the model cannot follow the data over 20 steps")
    problem = found.fit.problem
    problem.parameters.set(found.fit.theta)
    held_out = {f"{k:g}": float(v.square().mean().sqrt()) for k, v in found.held_out.items()}
    notes = {"departure": found.departure, "held_out_rms": held_out, "reason": found.fit.result.reason,
             "robust": problem.freedom is not None, "segment_steps": problem.grid.longest,
             "follows_data": True}  # fmt: skip
    return Fitted(model, found.fit.states(), "trajectory", problem.sigma, notes, problem.used)


def fit_by_smoothing(task: Task, seen: Look, plan: Plan) -> Fitted:  # noqa: ARG001
    """Fit parameters and every state, with a little noise in every step, from a short one-step fit."""
    model, sigma = _one_step_start(task, plan)
    found = fit_smoothing(task, model, sigma)
    if found is None:
        return _lost(task, model, "smoothing", sigma, "the model has no step near the data")
    problem = found.problem
    problem.parameters.set(problem.unpack(found.x)[0])
    notes = {"departure": weakest(task.config, model), "reason": found.result.reason, "process": problem.process,
             "robust": problem.freedom is not None, "follows_data": found.follows_data()}  # fmt: skip
    return Fitted(model, problem.states(found.x), "smoothing", problem.sigma, notes)


OBJECTIVES: dict[str, Callable[[Task, Look, Plan], Fitted]] = {
    "residual": fit_by_one_step,
    "raw": fit_by_one_step,
    "trajectory": fit_by_trajectory,
    "smoothing": fit_by_smoothing,
}


def _one_step_start(task: Task, plan: Plan) -> tuple[ContactLagrangian, float]:
    """A model without correction from a short one-step fit, and the noise of q that the plan or this fit gives."""
    model = task.build(plan.network)
    problem = one_step_problem(task, model, LOOSE * task.size, freedom=FREEDOM if plan.outliers else None, short=True)
    _, rms = fit_one_step(task, problem, "one-step start", PROBE)
    return model, plan.sigma or rms / NOISE_OF_R


def _missed(found: Chosen | None) -> tuple[int, float]:
    """What compares two fits to the same data: minus the steps of the segments followed, and the held-out error."""
    if found is None or not found.held_out:
        return 0, math.inf
    return -found.fit.problem.grid.length, float(found.held_out[found.departure].square().mean().sqrt())


def _lost(task: Task, model: ContactLagrangian, objective: str, sigma: float, why: str) -> Fitted:
    """The result for a model that does not follow the data, whose states are read off the recorded positions."""
    states = states_of_pairs(model, task.data)
    return Fitted(model, states, objective, sigma, {"reason": why, "follows_data": False})
