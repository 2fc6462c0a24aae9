"""Fitting noisy trajectories: growing segments, then the strength of the prior by held-out blocks of time."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.mechanics import legendre_minus
from herglotz.models import ContactLagrangian
from herglotz.training.baseline import Baseline
from herglotz.training.cross_validation import held_out_errors, simplest_not_beaten
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
    held_out: dict[float, Tensor]  # error of every fold, for every strength tried
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
) -> TrajectoryFit | None:
    """Fit parameters and states to positions (or, `frozen`, the states alone).

    Segments grow from 20 steps to whole trajectories, each stage started from the states of the one before. Then every
    prior strength is fitted in turn, the weakest first: its residuals give the noise that all strengths are fitted
    with. The strongest prior whose held-out error is not beaten beyond its spread wins.

    Returns
    -------
    TrajectoryFit or None
        From the longest segments that could be fitted; None if the model cannot follow even the shortest.
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
        return None
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
    problem, path, result = last
    grid = problem.grid
    first = TrajectoryFit(theta, problem, path, _noise(problem, path), departures[0], {}, result)
    fits: list[TrajectoryFit] = []
    held_out: dict[float, Tensor] = {}
    previous = first
    # The weakest prior twice: the first round finds the noise, which then stays the same for all.
    weakest = max(departures)
    for number, departure in enumerate([weakest, *sorted(departures, reverse=True)]):
        sigma = _noise(previous.problem, previous.path) if number <= 1 else previous.sigma
        problem = ShootingProblem(model, data, grid, sigma=sigma, prior=make_prior(model, base, departure))
        problem.path = previous.path
        states = problem.states_at(previous.path, grid.start_sample)
        name = f"prior {departure:g}" if number else "noise"
        result, new_theta = _optimise(problem, previous.theta, states, name, iterations, stages, False)
        cost, A, _ = problem.normal_equations(result.x)
        if problem.path is None or not bool(torch.isfinite(cost)):
            continue
        previous = TrajectoryFit(new_theta, problem, problem.path, sigma, departure, held_out, result)
        if number:
            fits.append(previous)
            held_out[departure] = held_out_errors(problem, problem.path, new_theta, A)
    if not fits:
        return first
    chosen = simplest_not_beaten(held_out)
    return next(f for f in fits if f.departure == chosen)


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


def _noise(problem: ShootingProblem, path: Path) -> float:
    """RMS of the residuals, in units of q."""
    return float(problem.misfit(path).square().mean().sqrt())
