"""Fitting the parameters and every state at once: joint smoothing, for data that no model follows for long.

Multiple shooting asks for a motion of the model in every segment. Here each step may be off by a little process noise:
pushes, chaos and unknown forces stay in the steps in which they act (weak-constraint estimation, Trémolet 2006; for
parameters of differential equations Ramsay et al. 2007). The price is that a force which process noise explains is not
learned.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from herglotz.models import ContactLagrangian
from herglotz.stepping import Stepper, state_of
from herglotz.stepping.block_tridiagonal import diagonal_of_inverse
from herglotz.training.cross_validation import Chosen, left_out_errors, strongest_not_beaten, without_rows
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.prior import prior_of
from herglotz.training.problems.robust import FREEDOM, heavy_tailed
from herglotz.training.problems.smoothing import DAMPING, SmoothingProblem
from herglotz.training.solvers.bordered import Bordered
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.task import Task
from herglotz.training.trajectory_fit import LOST, STAGE

# Rounds of the estimate of both noises, which starts with steps as noisy as the data.
ROUNDS = 8
# Largest factor by which the noise of the steps falls in a round: a poor model explains too little.
FALL = 10.0
# The rounds end where the logarithm of that noise changes by less.
SETTLED = 0.1
# Most numbers in q: a held-out fifth of them is solved for at once (1.3 GB, a few times).
MAX_NUMBERS = 20_000
# Least noise of the steps over that of the data: below, the states are a motion of the model.
LEAST = 1e-2
# Least σ relative to the largest |q|: rounding.
FLOOR = 1e-8


@dataclass(frozen=True)
class SmoothingFit:
    """A fit of parameters and all states at one noise of the steps and one strength of the prior."""

    x: Tensor  # (unknowns,) parameters, then states
    problem: SmoothingProblem
    result: OptimiserResult

    @property
    def theta(self) -> Tensor:
        """Parameters, (P,)."""
        return self.problem.unpack(self.x)[0]

    def follows_data(self) -> bool:
        """Whether free runs from the first states stay within a factor of the noise, without process noise."""
        problem, states = self.problem, self.problem.unpack(self.x)[1]
        start = state_of(problem.with_s(states[:, 0]))
        with torch.no_grad():
            stepper = Stepper(problem.parameters.at(self.theta))
            out = stepper.rollout(*start, h=problem.grid.h, inputs=problem.u)
        miss = problem.grid.at_samples(out.q) - problem.data.q
        return float(miss.square().mean().sqrt()) <= LOST * problem.sigma

    def held_out_errors(self) -> Tensor:
        """Of every fold, in units of q; see `cross_validation`."""
        problem, (_, matrix, _) = self.problem, self.problem.normal_equations(self.x)
        r = problem.misfit(self.x) / problem.sigma
        by = problem.root_weights(r)
        rows = (problem.grid.node[:, None] * problem.d + torch.arange(problem.n, device=r.device)).flatten() + problem.P

        weighted = (by * r).flatten()

        def left_out(own: Tensor) -> Tensor:
            return without_rows(_hat(matrix, rows[own], by.flatten()[own] / problem.sigma), weighted[own])

        return left_out_errors(weighted, problem.data, left_out) * problem.sigma


def fit_smoothing(task: Task, model: ContactLagrangian, sigma: float) -> Chosen[SmoothingFit] | None:
    """Fit parameters and all states to positions, and estimate the noise of the data and that of the steps.

    With `robust` "auto" the loss is Student's t where the residuals of the first stage have outliers. The weakest prior
    gives the noises. Every prior strength is then fitted in turn, the weakest first, and the strongest whose held-out
    error is not beaten beyond its spread wins (`cross_validation`). None where a step near the data has no solution.
    """
    config = task.config
    departures = config.departures if model.potential.network is not None else config.departures[:1]
    grid = segment_grid(task.data, task.data.samples, task.base.model_step)
    freedom = FREEDOM if config.robust == "on" else None

    def stage(name: str, x: Tensor | None, departure: float, process: float) -> SmoothingFit | None:
        noise, prior = max(sigma, FLOOR * task.size), prior_of(model, task.base, departure)
        problem = SmoothingProblem(model, task.data, grid, sigma=noise, process=process, prior=prior, freedom=freedom)
        return _minimised(task, name, problem, x)

    weakest = max(departures)
    first = stage("smoothing", None, weakest, 1.0)
    if first is None:
        return None
    last = first
    if config.robust == "auto" and heavy_tailed(last.problem.misfit(last.x)):
        freedom = FREEDOM
        last = stage("smoothing, robust", None, weakest, 1.0) or last
    for k in range(ROUNDS):
        before = last.problem.process
        sigma, process = _noises(last)
        process = max(process, before / FALL)
        last = stage(f"smoothing, noise {k + 1}", last.x, weakest, process) or last
        if abs(math.log(process / before)) < SETTLED:
            break
    sigma, process = _noises(last)

    def fit(departure: float) -> SmoothingFit | None:
        nonlocal last
        found = stage(f"smoothing, prior {departure:g}", last.x, departure, process)
        last = found or last
        return found

    found = strongest_not_beaten(departures, fit)
    return found or Chosen(last, weakest, {})


def _minimised(task: Task, name: str, problem: SmoothingProblem, x: Tensor | None) -> SmoothingFit | None:
    """The fit of a stage from x, or from the data; None where its cost is not finite."""
    start, most = problem.start() if x is None else x, min(task.config.iterations, STAGE)
    least = partial(levenberg_marquardt, problem, max_iterations=most, rtol=1e-4, patience=3, damping=DAMPING)
    result = task.stages.run(name, start, most, lambda x, callback: least(x, callback=callback))
    return SmoothingFit(result.x, problem, result) if math.isfinite(result.cost) else None


def _noises(fit: SmoothingFit) -> tuple[float, float]:
    """Standard deviations of the data's noise, and of the steps' noise relative to it, at stationary evidence.

    The states use tr H (the sum of their variances over σ²) of the N·n recorded values; the starts use S·d of these and
    the noise of the steps the rest: σ² = Σ r² / (N·n − tr H) and w² = Σ e² / (tr H − S·d), as in MacKay (1992).
    """
    problem = fit.problem
    misfit, (_, matrix, _) = problem.misfit(fit.x), problem.normal_equations(fit.x, held=True)
    used = problem.root_weights(misfit / problem.sigma).square()
    variances = problem.grid.at_samples(diagonal_of_inverse(matrix.blocks))[:, : problem.n]
    taken = float((variances / problem.deviations.square()).sum())
    free = misfit.numel() - taken
    starts = problem.grid.segments * problem.d
    sigma = math.sqrt(float((used * misfit.square()).sum()) / max(free, 0.1 * misfit.numel()))
    defect = problem.defects(fit.x)
    by = problem.root_weights(defect).square()
    w = problem.process * problem.sigma
    w *= math.sqrt(float((by * defect.square()).sum()) / max(taken - starts, 0.01 * starts))
    sigma = max(sigma, problem.sigma / FALL)
    return sigma, max(w / sigma, LEAST)


def _hat(matrix: Bordered, rows: Tensor, by: Tensor) -> Tensor:
    """J A⁻¹ Jᵀ of residuals by·x[rows]; not a number where A is not positive definite."""
    columns = by.new_zeros(len(matrix.diagonal()), len(rows))
    columns[rows, torch.arange(len(rows))] = by
    solved = matrix.solve_many(columns)
    return by.new_full((len(rows), len(rows)), torch.nan) if solved is None else by[:, None] * solved[rows]
