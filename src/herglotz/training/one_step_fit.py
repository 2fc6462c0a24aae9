"""Fitting by one-step errors: a short fit that others start from, or the whole fit where the data are exact."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from herglotz.data.windows import Triples
from herglotz.errors import refuse
from herglotz.models import ContactLagrangian
from herglotz.training.problems.one_step import OneStep, ResidualProblem, SupervisedProblem
from herglotz.training.problems.prior import prior_of
from herglotz.training.solvers.adam import DECAY, adam
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.stages import Callback
from herglotz.training.task import Task

# The standard deviation of r, as of q2 − 2 q1 + q0, over that of independent noise in q.
NOISE_OF_R = 6**0.5
# Iterations of each restart, at most a third of all iterations together; only the best restart goes on.
ITERATIONS_BEFORE_SELECTION = 30
# Seeds of restarts differ by this: no seed below 7919 shares a draw with another.
SEED_STRIDE = 7919
# Steps of Adam for one iteration of Levenberg–Marquardt: Adam needs no Jacobian, and many more steps.
ADAM_STEPS = 20
# Levenberg–Marquardt builds JᵀJ: 800 MB at this number of parameters, of which a search holds three.
MAX_PARAMETERS = 10_000
# Triples for each coefficient in a short fit.
SHORT_ROWS = 10
# Residuals for each coefficient in a one-step fit of found features: more residuals only cost time.
ROWS = 50
# Least relative gain of an iteration: of a fit, and of a fit that only measures or decides.
RTOL, HURRIED = 1e-6, 1e-3
# Least gain of log-likelihood where σ is that of rounding: smaller gains say nothing more about the model.
MIN_LIKELIHOOD_GAIN = 0.01


def one_step_problem(
    task: Task,
    model: ContactLagrangian,
    sigma: float,
    *,
    metric: str = "position",
    freedom: float | None = None,
    expected: tuple[Triples, float] | None = None,
    s: Tensor | None = None,
    short: bool = False,
) -> OneStep:
    """The one-step objective that the settings ask for: of positions, or of s (and p) beside them.

    `s` (N,) is near s at every sample. `short`: the objective measures the noise or starts another fit; the triples of
    a long recording are not all needed.
    """
    config, base = task.config, task.base
    prior = prior_of(model, base, config.departures[-1])
    shared = {"max_step": base.max_step, "sigma": sigma, "prior": prior, "freedom": freedom}
    if config.supervision != "q":
        return SupervisedProblem(model, task.data, momenta=config.supervision == "qps", **shared)
    rows = SHORT_ROWS if short else ROWS if config.coupled and base.start else None
    most = None if rows is None or prior is None else rows * prior.start.numel()
    return ResidualProblem(model, task.data, metric=metric, expected=expected, most=most, s=s, **shared)


def fit_one_step(task: Task, problem: OneStep, name: str, iterations: int) -> tuple[OptimiserResult, float]:
    """Minimise a one-step objective, write the result into its model, and return it with the RMS error of q."""
    total = iterations if task.config.optimiser == "lm" else ADAM_STEPS * iterations
    start = problem.start()
    result = task.stages.run(name, start, total, lambda x, callback: _optimised(task, problem, x, total, callback))
    rms = float(problem.residuals(result.x).square().mean().sqrt())
    problem.parameters.set(result.x[: problem.P])
    return result, rms


def _optimised(task: Task, problem: OneStep, x: Tensor, total: int, callback: Callback) -> OptimiserResult:
    """Minimise by the optimiser of the settings; raise InputError where the model is too large for its matrix."""
    c = task.config
    if c.optimiser != "lm":
        return adam(
            problem, x, max_iterations=total, learning_rate=c.learning_rate,
            decay=DECAY if c.optimiser == "adamw" else 0.0, batch=c.batch, seed=c.seed, callback=callback,
        )  # fmt: skip
    refuse({
        f"the model has {problem.P} parameters, more than the {MAX_PARAMETERS} that Levenberg–Marquardt takes; set "
        "optimiser='adam' and objective='residual', or make the network smaller": problem.P > MAX_PARAMETERS,
    })  # fmt: skip
    rtol, atol = HURRIED if task.hurried else RTOL, MIN_LIKELIHOOD_GAIN if problem.sigma <= task.exact else 0.0
    return levenberg_marquardt(problem, x, max_iterations=total, rtol=rtol, atol=atol, callback=callback)


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
