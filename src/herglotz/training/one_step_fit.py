"""Fitting by one-step errors: a short fit that others start from, or the whole fit where the data are exact."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from herglotz.data.windows import Triples
from herglotz.models import ContactLagrangian
from herglotz.training.problems.one_step import OneStep, ResidualProblem
from herglotz.training.problems.prior import prior_of
from herglotz.training.problems.supervised import SupervisedProblem
from herglotz.training.solvers.adam import DECAY, adam
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.solvers.matrix_free import DENSE, MatrixFree
from herglotz.training.stages import Callback
from herglotz.training.task import Task

NOISE_OF_R = 6**0.5  # standard deviation of q2 − 2 q1 + q0, hence of r, over that of independent noise in q
ITERATIONS_BEFORE_SELECTION = 30  # of each restart, at most a third of all iterations together; only the best goes on
SEED_STRIDE = 7919  # between the seeds of restarts: no seed below 7919 shares a draw with another
ADAM_STEPS = 20  # steps of Adam for one iteration of Levenberg–Marquardt: Adam needs no Jacobian, and many more steps
SHORT_ROWS = 10  # triples for each coefficient in a short fit
RTOL, HURRIED = 1e-6, 1e-3  # least gains, relative, of iterations; of fits that only measure or decide
UNLIKELIER = 0.01  # of log-likelihood, where σ is that of rounding: lower costs say nothing more about the model
ROWS = 50  # residuals for each coefficient in a one-step fit of found features: more only cost time


def one_step_problem(
    task: Task,
    model: ContactLagrangian,
    sigma: float,
    *,
    metric: str = "position",
    freedom: float | None = None,
    expected: tuple[Triples, float] | None = None,
    short: bool = False,
) -> OneStep:
    """The one-step objective that the settings ask for: of positions, or of s (and p) beside them.

    `short`: it measures the noise or starts another fit; the triples of a long recording are not all needed.
    """
    config, base = task.config, task.base
    prior = prior_of(model, base, config.departures[-1])
    shared = {"max_step": base.max_step, "sigma": sigma, "prior": prior, "freedom": freedom}
    if config.supervision != "q":
        return SupervisedProblem(model, task.data, momenta=config.supervision == "qps", **shared)
    rows = SHORT_ROWS if short else ROWS if config.coupled and base.start else None
    most = None if rows is None or prior is None else rows * prior.start.numel()
    return ResidualProblem(model, task.data, metric=metric, expected=expected, most=most, **shared)


def fit_one_step(task: Task, problem: OneStep, name: str, iterations: int) -> tuple[OptimiserResult, float]:
    """Minimise a one-step objective, write the result into its model, and return it with the RMS error of q."""
    total = iterations if task.config.optimiser == "lm" else ADAM_STEPS * iterations
    start = problem.start()
    result = task.stages.run(name, start, total, lambda x, callback: _optimised(task, problem, x, total, callback))
    rms = float(problem.residuals(result.x).square().mean().sqrt())
    problem.parameters.set(result.x[: problem.P])
    return result, rms


def _optimised(task: Task, problem: OneStep, x: Tensor, total: int, callback: Callback) -> OptimiserResult:
    """The end of a search from x; Levenberg–Marquardt forms no matrix where there are too many parameters for one."""
    c = task.config
    if c.optimiser != "lm":
        return adam(
            problem, x, max_iterations=total, learning_rate=c.learning_rate,
            decay=DECAY if c.optimiser == "adamw" else 0.0, batch=c.batch, seed=c.seed, callback=callback,
        )  # fmt: skip
    large = isinstance(problem, ResidualProblem) and not problem.carries_s and problem.P > DENSE
    target = MatrixFree(problem) if large and isinstance(problem, ResidualProblem) else problem
    rtol, atol = HURRIED if task.hurried else RTOL, UNLIKELIER if problem.sigma <= task.exact else 0.0
    return levenberg_marquardt(target, x, max_iterations=total, rtol=rtol, atol=atol, callback=callback)


def best_restart(
    task: Task, network: str, restarts: int, make: Callable[[ContactLagrangian], OneStep]
) -> tuple[ContactLagrangian, int]:
    """The model with the lowest cost after a short fit from each of several random initialisations.

    Some initialisations stall a hundred times higher than others. Returns the model and the iterations that are left.
    """
    total = task.config.iterations
    each = min(ITERATIONS_BEFORE_SELECTION, total // (3 * restarts))
    tried = []
    for k in range(restarts):
        model = task.build(network, seed=task.config.seed + k * SEED_STRIDE)
        result, _ = fit_one_step(task, make(model), f"one-step error, start {k + 1}", each)
        tried.append((result.cost, k, model))
    return min(tried)[2], total - each * restarts
