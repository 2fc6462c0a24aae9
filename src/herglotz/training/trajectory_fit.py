"""Fitting noisy trajectories: growing segments, then the strength of the prior by held-out blocks of time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.training.baseline import Baseline
from herglotz.training.cross_validation import held_out_errors, simplest_not_beaten
from herglotz.training.first_states import first_states
from herglotz.training.flat import FlatModel
from herglotz.training.grid import segment_grid
from herglotz.training.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.lifted import Path
from herglotz.training.prior import Prior
from herglotz.training.robust import FAR, FEW, FREEDOM, far_out, heavy_tailed, scale_of
from herglotz.training.shooting import ShootingProblem
from herglotz.training.stages import Stages

FIRST_SEGMENT = 20  # recorded steps; later stages double it
MOST = 10_000  # states of segments, in numbers: they are solved for together, in one dense matrix (800 MB)
LOST = 2.0  # segments stop growing where they miss the data by so many times what shorter ones do


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


@dataclass(frozen=True)
class _Stage:
    """A fit at one length of the segments."""

    theta: Tensor  # (P,)
    problem: ShootingProblem
    path: Path
    result: OptimiserResult

    @property
    def misfit(self) -> Tensor:
        """Residuals of the data that are used, (N', n), in units of q."""
        return self.problem.misfit(self.path)[self.problem.used[self.problem.grid.sample]]

    @property
    def noise(self) -> float:
        """Their scale."""
        return _noise(self.problem, self.path)


class StateEquations(Protocol):
    """A problem over parameters and states, the parameters first, whose equations of the states can be had alone."""

    def cost(self, x: Tensor) -> Tensor:
        """See `LeastSquares`."""
        ...

    def normal_equations(self, x: Tensor, *, held: bool) -> tuple[Tensor, Any, Tensor]:
        """See `LeastSquares`; `held`: of the states alone."""
        ...


class StatesOnly:
    """Such a problem with the parameters held: only the states are fitted."""

    def __init__(self, problem: StateEquations, theta: Tensor):
        self.problem, self.theta = problem, theta

    def full(self, states: Tensor) -> Tensor:
        """All unknowns of the problem."""
        return torch.cat([self.theta, states])

    def cost(self, x: Tensor) -> Tensor:
        """See `LeastSquares`."""
        return self.problem.cost(self.full(x))

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Any, Tensor]:
        """See `LeastSquares`."""
        return self.problem.normal_equations(self.full(x), held=True)


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


def check_size(data: Trajectories, most: int = MOST * FIRST_SEGMENT // 2) -> None:
    """That there are no more than `most` numbers in q: what is solved for together grows with their square.

    Raises
    ------
    InputError
        Naming how many samples there are, how many can be, and which thinning leaves as many.
    """
    allowed = most // data.dof
    if data.samples <= allowed:
        return
    every = math.ceil(data.samples / allowed)
    raise InputError(
        f"{data.samples} samples to fit, at most {allowed} can be with {data.dof} coordinate(s), for the states of all "
        f"segments are solved for together; thin them (--every {every}, Trajectories.thinned) or take fewer"
    )


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
    robust: str = "auto",
    s: Tensor | None = None,
) -> TrajectoryFit | None:
    """Fit parameters and states to positions (or, `frozen`, the states alone).

    Segments grow from 20 steps to whole trajectories, or as long as the model follows the data, each stage started from
    the states of the one before. With `robust` "auto" the first stage is fitted with Student's t as well. Where that
    shows outliers, and they are few, they are left out and least squares go on with the rest; where the rest has
    outliers still, or they are many, Student's t is the loss of all further stages (`herglotz.training.robust`). Then
    every prior strength is fitted in turn, the weakest first: its residuals give the noise that all strengths are
    fitted with. The strongest prior whose held-out error is not beaten beyond its spread wins.

    Returns
    -------
    TrajectoryFit or None
        From the longest segments that could be fitted; None if the model cannot follow even the shortest.
    """
    if model.potential.network is None or frozen:
        departures = departures[:1]
    theta, exact = FlatModel(model).get(), 1e-6 * max(base.scale)

    def stage(
        length: int, sigma: float, freedom: float | None, before: _Stage | None, used: Tensor | None = None
    ) -> _Stage | None:
        grid = segment_grid(data, length, base.model_step)
        prior = make_prior(model, base, departures[0])
        problem = ShootingProblem(model, data, grid, sigma=sigma, prior=prior, freedom=freedom, used=used, s=s)
        if before is None:
            start, states = theta, first_states(problem, theta)
        else:
            start, states = before.theta, before.problem.states_at(before.path, grid.start_sample)
        name = f"segments of {length}" + (", robust" if freedom else "" if used is None else ", outliers left out")
        result, found = _optimise(problem, start, states, name, iterations, stages, frozen)
        path = problem.solve(problem.pack(found, result.x[-states.numel() :].reshape(states.shape)))
        return None if path is None or not math.isfinite(result.cost) else _Stage(found, problem, path, result)

    freedom, used = (FREEDOM if robust == "on" else None), None
    lengths = segment_lengths(data)
    last = stage(lengths[0], sigma, freedom, None)
    if last is None:
        return None
    if robust == "auto" and not frozen:  # outliers stand out best where segments are short
        trial = stage(lengths[0], max(scale_of(last.misfit), 1e-3 * exact), FREEDOM, None)
        if trial is not None and heavy_tailed(trial.misfit):
            rest = _without_outliers(trial, lambda sigma, used: stage(lengths[0], sigma, None, trial, used))
            last, freedom, used = (trial, FREEDOM, None) if rest is None else (rest, None, rest.problem.used)
    best = last.noise
    for length in lengths[1:]:
        if not frozen:
            sigma = last.noise if freedom else max(sigma, last.noise)
        longer = stage(length, sigma, freedom, last, used)
        if longer is None or (not frozen and longer.noise > LOST * max(best, exact)):
            break  # no parameters follow the data for so long: chaos, or forces that the model does not know
        last, best = longer, min(best, longer.noise)
    if frozen:
        return TrajectoryFit(last.theta, last.problem, last.path, sigma, None, {}, last.result)
    return _choose_departure(model, data, base, departures, iterations, stages, last)


def _without_outliers(trial: _Stage, again: Callable[[float, Tensor], _Stage | None]) -> _Stage | None:
    """The same segments by least squares without the samples far from the robust fit; None if outliers remain.

    A heavy-tailed loss finds outliers, but fits what is left less well than least squares do (reweighted least squares,
    Rousseeuw & Leroy 1987). A push breaks a joint, and no sample that is left out can mend it.
    """
    problem = trial.problem
    out = far_out(trial.misfit)
    if float(out.double().mean()) > FEW:
        return None
    used = torch.ones_like(problem.used)
    used[problem.grid.sample[out]] = False
    rest = again(trial.noise, used)
    if rest is None or heavy_tailed(rest.misfit) or float(rest.problem.joint_residuals(rest.path).abs().max()) > FAR:
        return None
    return rest


def _choose_departure(
    model: ContactLagrangian,
    data: Trajectories,
    base: Baseline,
    departures: tuple[float, ...],
    iterations: int,
    stages: Stages,
    last: _Stage,
) -> TrajectoryFit:
    grid = last.problem.grid
    first = TrajectoryFit(last.theta, last.problem, last.path, last.noise, departures[0], {}, last.result)
    fits: list[TrajectoryFit] = []
    held_out: dict[float, Tensor] = {}
    previous = first
    # The weakest prior twice: the first round finds the noise, which then stays the same for all.
    weakest = max(departures)
    for number, departure in enumerate([weakest, *sorted(departures, reverse=True)]):
        sigma = _noise(previous.problem, previous.path) if number <= 1 else previous.sigma
        prior = make_prior(model, base, departure)
        problem = ShootingProblem(
            model, data, grid, sigma=sigma, prior=prior, freedom=last.problem.freedom, used=last.problem.used
        )
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


def _noise(problem: ShootingProblem, path: Path) -> float:
    """Scale of the residuals, in units of q: their RMS, that of their bulk where the loss is robust."""
    misfit = problem.misfit(path)[problem.used[problem.grid.sample]]
    return scale_of(misfit) if problem.freedom else float(misfit.square().mean().sqrt())
