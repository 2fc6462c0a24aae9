"""Fitting noisy trajectories: growing segments, then the prior strength by evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.mechanics import legendre_minus
from herglotz.models import ContactLagrangian
from herglotz.training.baseline import Baseline
from herglotz.training.grid import segment_grid
from herglotz.training.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.lifted import Path
from herglotz.training.prior import Prior
from herglotz.training.shooting import ShootingProblem
from herglotz.training.stages import Stages

FIRST_SEGMENT = 20  # recorded steps; later stages double it


@dataclass(frozen=True)
class TrajectoryFit:
    """The chosen fit."""

    theta: Tensor  # (P,)
    problem: ShootingProblem
    path: Path
    sigma: float  # noise of q
    departure: float | None  # prior strength, where the model has a potential network
    evidence: dict[str, float]  # log evidence of every strength tried
    result: OptimiserResult


class StatesOnly:
    """A shooting problem with the parameters held: only the segment states are fitted."""

    def __init__(self, problem: ShootingProblem, theta: Tensor):
        self.problem, self.theta = problem, theta

    def full(self, states: Tensor) -> Tensor:
        """All unknowns of the shooting problem."""
        return torch.cat([self.theta, states])

    def cost(self, x: Tensor) -> Tensor:
        """See `LeastSquares`."""
        return self.problem.cost(self.full(x))

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `LeastSquares`."""
        cost, A, b = self.problem.normal_equations(self.full(x))
        P = len(self.theta)
        return cost, A[P:, P:], b[P:]


def make_prior(model: ContactLagrangian, base: Baseline, departure: float | None) -> Prior:
    """The prior every objective uses, sized by the data."""
    typical = min(v / s for v, s in zip(base.speed, base.scale, strict=True))
    return Prior(model, base.low, base.high, departure=departure, weight=1.0, rate_spread=0.3 * typical)


def segment_lengths(data: Trajectories) -> list[int]:
    """Segment lengths of the stages: 20, 40, 80, … recorded steps, and at last each trajectory whole."""
    longest = max(data.lengths) - 1
    lengths = []
    length = FIRST_SEGMENT
    while length < longest:
        lengths.append(length)
        length *= 2
    return [*lengths, longest]


def fit_trajectories(
    model: ContactLagrangian,
    data: Trajectories,
    base: Baseline,
    sigma: float,
    departures: tuple[float, ...],
    iterations: int,
    stages: Stages,
    *,
    frozen: bool = False,
) -> TrajectoryFit:
    """Fit parameters and states to positions (or, `frozen`, the states alone).

    Segments grow from 20 steps to whole trajectories, each stage started from the states of the one before. Then every
    prior strength is fitted in turn, the noise is re-estimated, and the strength with the largest Laplace evidence wins.

    Returns
    -------
    TrajectoryFit
        From the longest segments that could be fitted.
    """
    if model.potential.network is None or frozen:
        departures = departures[:1]
    theta = ShootingProblem(model, data, segment_grid(data, FIRST_SEGMENT, base.max_step), sigma=sigma).flat.get()
    last: tuple[ShootingProblem, Path, OptimiserResult] | None = None
    for length in segment_lengths(data):
        grid = segment_grid(data, length, base.max_step)
        problem = ShootingProblem(model, data, grid, sigma=sigma, prior=make_prior(model, base, departures[0]))
        states = _first_states(problem, theta) if last is None else last[0].states_at(last[1], grid.start_sample)
        result, theta_new = _optimise(problem, theta, states, f"segments of {length}", iterations, stages, frozen)
        path = problem.solve(problem.pack(theta_new, result.x[-states.numel() :].reshape(states.shape)))
        if path is None or not math.isfinite(result.cost):
            break
        theta, last = theta_new, (problem, path, result)
    if last is None:
        raise FloatingPointError("no segment of the data could be followed; the steps are too long for this model")
    if frozen:
        problem, path, result = last
        return TrajectoryFit(theta, problem, path, sigma, None, {}, result)
    return _choose_departure(model, data, base, departures, iterations, stages, theta, last)


def _choose_departure(
    model: ContactLagrangian,
    data: Trajectories,
    base: Baseline,
    departures: tuple[float, ...],
    iterations: int,
    stages: Stages,
    theta: Tensor,
    last: tuple[ShootingProblem, Path, OptimiserResult],
) -> TrajectoryFit:
    problem, path, _ = last
    grid, sigma = problem.grid, _noise(problem, path, len(theta))
    fits: list[TrajectoryFit] = []
    evidence: dict[str, float] = {}
    for departure in departures:
        start_path = path if not fits else fits[-1].path
        start_theta = theta if not fits else fits[-1].theta
        for round_ in (1, 2):  # the second with the noise that the first one found
            problem = ShootingProblem(model, data, grid, sigma=sigma, prior=make_prior(model, base, departure))
            states = problem.states_at(start_path, grid.start_sample)
            problem.path = start_path
            name = f"prior {departure:g}, round {round_}"
            result, new_theta = _optimise(problem, start_theta, states, name, iterations, stages, False)
            x = result.x
            cost, A, _ = problem.normal_equations(x)
            new_path = problem.path
            if new_path is None or not bool(torch.isfinite(cost)):
                break
            start_path, start_theta = new_path, new_theta
            prior_A = problem.prior.normal_equations(new_theta)[1] if problem.prior is not None else A * 0
            effective = _effective_parameters(A, prior_A)
            value = _log_evidence(problem, new_theta, float(cost), A)
            sigma_new = _noise(problem, new_path, effective)
            fit = TrajectoryFit(new_theta, problem, new_path, sigma, departure, evidence, result)
            sigma = sigma_new
        else:
            fits.append(fit)
            evidence[f"{departure:g}"] = value
    if not fits:
        problem, path, result = last
        return TrajectoryFit(theta, problem, path, sigma, departures[0], evidence, result)
    return max(fits, key=lambda f: evidence[f"{f.departure:g}"])


def _optimise(
    problem: ShootingProblem,
    theta: Tensor,
    states: Tensor,
    name: str,
    iterations: int,
    stages: Stages,
    frozen: bool,
) -> tuple[OptimiserResult, Tensor]:
    target = StatesOnly(problem, theta) if frozen else problem
    x = states.reshape(-1) if frozen else problem.pack(theta, states)
    total = min(iterations, 40)
    result = stages.run(
        name,
        x,
        total,
        lambda x, callback: levenberg_marquardt(
            target, x, max_iterations=total, rtol=1e-4, patience=3, callback=callback
        ),
    )
    return result, theta if frozen else problem.unpack(result.x)[0]


def _first_states(problem: ShootingProblem, theta: Tensor) -> Tensor:
    """Segment states from the first two samples of each, p by FL⁻."""
    i, data = problem.grid.start_sample, problem.data
    with torch.no_grad():
        zero = torch.zeros_like(data.t[i])
        q, p, _ = legendre_minus(problem.flat.at(theta), data.q[i], data.q[i + 1], zero, data.t[i + 1] - data.t[i])
    return problem.states(q, p)


def _noise(problem: ShootingProblem, path: Path, used: float) -> float:
    """σ of the residuals, with the degrees of freedom that the fit used up taken off (never more than half)."""
    misfit = problem.misfit(path)
    free = max(misfit.numel() - used, misfit.numel() / 2)
    return float((misfit.square().sum() / free).sqrt())


def _effective_parameters(A: Tensor, prior_A: Tensor) -> float:
    """tr(A⁻¹ A_data): how many parameters the data, not the prior, decided."""
    P = len(prior_A)
    data_A = A.clone()
    data_A[:P, :P] -= prior_A
    return float(torch.linalg.lstsq(A.double(), data_A.double()).solution.trace())


def _log_evidence(problem: ShootingProblem, theta: Tensor, cost: float, A: Tensor) -> float:
    """Laplace's log evidence of the prior strength, up to a constant shared by all strengths.

    −cost − N log σ + ½ log det Λ_prior − ½ log det A, over parameters and states (MacKay 1992).
    """
    observations = problem.grid.sample.numel() * problem.n
    prior = 0.0 if problem.prior is None else float(problem.prior.log_determinant(theta))
    posterior = float(torch.linalg.slogdet(A.double()).logabsdet)
    return -cost - observations * math.log(problem.sigma) + prior / 2 - posterior / 2
