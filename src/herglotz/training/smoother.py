"""Joint smoothing: every state is an unknown, of a fixed model or together with its parameters.

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

from herglotz.data import Trajectories
from herglotz.data.checks import check_positive
from herglotz.data.smoothing import smoothed
from herglotz.data.trajectories import GAP
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper, state_of
from herglotz.training.config import FitConfig
from herglotz.training.first_states import first_states
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.least_squares import StatesOnly
from herglotz.training.problems.prior import prior_of
from herglotz.training.problems.robust import FREEDOM, heavy_tailed
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.smoothing import DAMPING, SmoothingProblem
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.task import Task
from herglotz.training.trajectory_fit import LOST, STAGE

# Process noise per radian of motion over the measurement noise (`smooth`): small, so that states follow the model.
PROCESS_NOISE = 0.1
# Rounds of the estimate of both noises, which starts with steps as noisy as the data.
ROUNDS = 8
# The noise of the steps falls by at most this factor in a round: a poor model of the first rounds explains too little.
MAX_FALL = 10.0
# The rounds end if the logarithm of the noise of the steps changes by less than this.
MIN_CHANGE = 0.1
# The noise of the steps over the noise of the data is at least this: below, the states are a motion of the model.
MIN_PROCESS = 1e-2
# σ relative to the largest |q| is at least this: below, residuals are rounding.
MIN_SIGMA = 1e-8


@dataclass(frozen=True)
class Smoothed:
    """States at every sample and their standard errors for a fixed model; s has 0 if the motion has no s."""

    states: State  # (N, n), (N, n), (N,)
    std: State  # (N, n), (N, n), (N,)


def smooth(model: ContactLagrangian, data: Trajectories, sigma: float, *, process: float = 0.1) -> Smoothed:
    """The smoothed states of each trajectory for a fixed model; steps may differ, and samples may be missing.

    `sigma` is the standard deviation of the noise of q, in units of q, `process` the process noise
    (`SmoothingProblem`). With a small process noise the states follow the model, with a large one the data. Raise
    InputError if sigma or process is not positive, or a step has no solution near the data.
    """
    check_positive("sigma", sigma)
    check_positive("process", process)
    data = data.unwrapped()
    grid = segment_grid(data, data.samples, GAP * data.typical_step)
    problem = SmoothingProblem(model, data, grid, sigma=sigma, process=process)
    if (solved := smoothed_states(problem)) is None:
        where = data.source or "data"
        raise InputError(
            f"{where}: a step of the model near these data fails, so nothing can be smoothed; fit it again"
        )
    x, _ = solved
    found = problem.states(x)
    std = torch.zeros_like(found)
    std[:, : problem.d] = problem.variances(x).clamp_min(0).sqrt()
    return Smoothed(*(state_of(y) for y in (found, std)))


def process_noise(model: ContactLagrangian, h: float) -> float:
    """`process` of `SmoothingProblem` for steps h, which grows as √h: the variance of a random force adds up."""
    angle = h * max(v / x for v, x in zip(model.config.speed, model.config.scale, strict=True))
    return PROCESS_NOISE * min(1.0, angle) ** 0.5


def smoothed_states(problem: SmoothingProblem) -> tuple[Tensor, float] | None:
    """All unknowns with smoothed states and a fixed model, and ½|r|²; None if a step near the data fails."""
    x = smoothing_start(problem)
    states = StatesOnly(problem, x[: problem.P])
    result = levenberg_marquardt(states, x[problem.P :], rtol=1e-6, patience=1, damping=DAMPING)
    return None if result.reason == "not_finite" else (states.full(result.x), result.cost)


def smoothing_start(problem: SmoothingProblem) -> Tensor:
    """The start of smoothing: straight lines between samples, or with dry friction a motion of the model near the data.

    A sticking joint stands still whatever its momentum: there the positions of a start with defects have no slope by
    the momenta, and the defects stay. A motion of the model has no defects.
    """
    x, data, model = problem.start(), problem.data, problem.parameters.model
    if model.friction is None or not model.friction.dry:
        return x
    shooting = ShootingProblem(model, data, problem.grid, sigma=problem.sigma)
    theta = shooting.parameters.get()
    states = first_states(shooting, theta, smoothed(data))
    found = levenberg_marquardt(StatesOnly(shooting, theta), states.flatten())
    path = shooting.solve(shooting.pack(theta, found.x))
    return x if path is None else torch.cat([theta, path.x[..., : problem.d].flatten()])


@dataclass(frozen=True)
class SmoothingFit:
    """A fit of parameters and all states at one noise of the steps."""

    x: Tensor  # (unknowns,) parameters, then states
    problem: SmoothingProblem
    result: OptimiserResult

    def follows_data(self) -> bool:
        """Whether free runs from the first states stay within a factor of the noise, without process noise."""
        problem = self.problem
        theta, states = problem.unpack(self.x)
        with torch.no_grad():
            stepper, start = Stepper(problem.parameters.at(theta)), state_of(problem.with_s(states[:, 0]))
            out = stepper.rollout(*start, h=problem.grid.h, inputs=problem.u)
        miss = problem.grid.at_samples(out.q) - problem.data.q
        return float(miss.square().mean().sqrt()) <= LOST * problem.sigma


def fit_smoothing(task: Task, model: ContactLagrangian, sigma: float) -> SmoothingFit | None:
    """Fit parameters and all states to positions, and estimate the noise of the data and that of the steps.

    With `robust` "auto" the loss is Student's t where the residuals of the first stage have outliers. The prior is the
    weakest of the settings: the noise of the steps, not a network, follows pushes. On seven recordings a choice by
    held-out blocks predicted better by at most 3 %. None if a step near the data has no solution.
    """
    config = task.config
    prior = prior_of(model, task.base, weakest(config, model))
    grid = segment_grid(task.data, task.data.samples, task.base.model_step)
    freedom = FREEDOM if config.robust == "on" else None

    def stage(name: str, x: Tensor | None, process: float) -> SmoothingFit | None:
        noise = max(sigma, MIN_SIGMA * task.size)
        problem = SmoothingProblem(model, task.data, grid, sigma=noise, process=process, prior=prior, freedom=freedom)
        return _minimised(task, name, problem, x)

    last = stage("smoothing", None, 1.0)
    if last is None:
        return None
    if config.robust == "auto" and heavy_tailed(last.problem.misfit(last.x)):
        freedom = FREEDOM
        last = stage("smoothing, robust", None, 1.0) or last
    for k in range(ROUNDS):
        before = last.problem.process
        sigma, process = _noises(last)
        process = max(process, before / MAX_FALL)
        last = stage(f"smoothing, noise {k + 1}", last.x, process) or last
        if abs(math.log(process / before)) < MIN_CHANGE:
            break
    sigma, process = _noises(last)
    return stage("smoothing, last", last.x, process) or last


def weakest(config: FitConfig, model: ContactLagrangian) -> float:
    """The weakest prior of the settings; a model without a network has the first one."""
    return config.departures[0] if model.potential.network is None else max(config.departures)


def _minimised(task: Task, name: str, problem: SmoothingProblem, x: Tensor | None) -> SmoothingFit | None:
    """The fit of a stage from x, or from the data; None if the cost of the fit is not finite."""
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
    misfit = problem.misfit(fit.x)
    used = problem.root_weights(misfit / problem.sigma).square()
    taken = float((problem.variances(fit.x)[:, : problem.n] / problem.deviations.square()).sum())
    free = misfit.numel() - taken
    starts = problem.grid.segments * problem.d
    sigma = math.sqrt(float((used * misfit.square()).sum()) / max(free, 0.1 * misfit.numel()))
    defect = problem.defects(fit.x)
    by = problem.root_weights(defect).square()
    w = problem.process * problem.sigma
    w *= math.sqrt(float((by * defect.square()).sum()) / max(taken - starts, 0.01 * starts))
    sigma = max(sigma, problem.sigma / MAX_FALL)
    return sigma, max(w / sigma, MIN_PROCESS)
