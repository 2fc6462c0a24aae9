"""Fitting noisy trajectories: growing segments, then the strength of the prior by held-out blocks of time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.data.roughness import precision, spread
from herglotz.models import ContactLagrangian
from herglotz.training.cross_validation import held_out_errors, simplest_not_beaten
from herglotz.training.first_states import first_states, states_of_pairs
from herglotz.training.problems.grid import segment_grid, segment_lengths
from herglotz.training.problems.least_squares import StatesOnly
from herglotz.training.problems.prior import prior_of
from herglotz.training.problems.robust import FAR, FEW, FREEDOM, far_out, heavy_tailed, scale_of
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, levenberg_marquardt
from herglotz.training.solvers.lifted_newton import Path
from herglotz.training.task import Task

LOST = 2.0  # segments stop growing where they miss the data by so many times what shorter ones do
FOLLOWED = 0.05  # of the spread of q: segments that miss less follow the motion, and grow on to simulation error
FLOOR = 1e-6  # of the largest |q|: errors below it are no reason to stop growing segments
WIDER = (30.0, 900.0)  # times weaker priors: the next ranges start where the default one ends, the last at 5 baselines
HALVED = 2.0  # factor by which a weaker prior has to lower the error of the shortest segments
SMALL = 1e-2  # of the largest |q|: shortest segments that miss less lack no force as large as the baseline's
NOT_THE_NOISE = 1.5  # times the data's precision; as in the verdict
FAR_OFF, NEAR = 1e-3, 1e-8  # damping of the first iteration: steps are Newton's near the minimum
STAGE = 40  # iterations of a stage at most: a start near the optimum needs fewer, and a poor one is left by the next
MANY = 4  # coordinates: of more, an iteration takes up to 0.2 s, and gains of 1e-4 would be waited for minutes


@dataclass(frozen=True)
class TrajectoryFit:
    """A fit of parameters and segment states at one length of the segments and one strength of the prior."""

    theta: Tensor  # (P,)
    problem: ShootingProblem
    path: Path
    result: OptimiserResult

    @property
    def misfit(self) -> Tensor:
        """Residuals of the complete samples that are used, (N', n), in units of q."""
        return self.problem.misfit(self.path)[self.problem.used & self.problem.data.complete]

    @property
    def noise(self) -> float:
        """Scale of the residuals, in units of q: their RMS, that of their bulk where the loss is robust."""
        return scale_of(self.misfit) if self.problem.freedom else float(self.misfit.square().mean().sqrt())

    def follows(self, sigma: float) -> bool:
        """Whether it misses the data by no more than twice σ."""
        return self.noise <= LOST * sigma

    def loses(self, plain: TrajectoryFit) -> bool:
        """Whether it has lost data that least squares follow: what lies far from both alone is an outlier."""
        own, its = (float(fit.misfit.square().mean().sqrt()) for fit in (self, plain))
        return own > NOT_THE_NOISE * its

    def states(self) -> Tensor:
        """The fitted trajectory at the samples, (N, 2n+1)."""
        return self.problem.grid.at_samples(self.path.x)

    def held_out_errors(self) -> Tensor:
        """Of every fold, in units of q; see `cross_validation`."""
        problem = self.problem
        _, A, _ = problem.normal_equations(self.result.x)
        return held_out_errors(problem, self.path, self.theta, A)


@dataclass(frozen=True)
class Chosen:
    """The fit with the strength of the prior that held-out blocks chose, and the errors of all strengths."""

    fit: TrajectoryFit
    departure: float
    held_out: dict[float, Tensor]  # (FOLDS,) in units of q


class SegmentStages:
    """Fits of one model at growing segment lengths, from its current parameters; `frozen` fits the states alone.

    `s` (N,) is s at every sample in the model's unit, where it is known; `label` sets the names of these stages apart
    from those of others in the same fit.
    """

    def __init__(
        self, task: Task, model: ContactLagrangian, *, frozen: bool = False, s: Tensor | None = None, label: str = ""
    ):
        self.task, self.model, self.frozen, self.s, self.label = task, model, frozen, s, label
        self.lengths = segment_lengths(task.data)
        self.patient, self.many = True, task.data.dof > MANY  # patient: where no path is known, it is stepped through
        self.hurried = task.hurried or self.many  # stages before the last, and of states, end where they gain < 1 %
        self.compared = self.many and model.potential.network is not None  # fits with other priors are last

    def fit(
        self,
        length: int,
        sigma: float,
        freedom: float | None,
        before: TrajectoryFit | None,
        used: Tensor | None = None,
        *,
        near: bool = False,
    ) -> TrajectoryFit | None:
        """Segments of one length, from the states of the stage before or of the data; None where no path is found.

        `near`: see `optimise`.
        """
        task = self.task
        grid = segment_grid(task.data, length, task.base.model_step)
        problem = ShootingProblem(
            self.model, task.data, grid, sigma=sigma, prior=prior_of(self.model, task.base, task.config.departures[0]),
            freedom=freedom, used=used, s=self.s,
        )  # fmt: skip
        if before is None:
            start = problem.parameters.get()
            states = first_states(problem, start)
            problem.guess_from_states(states_of_pairs(self.model, task.data))
        else:
            start, states = before.theta, before.problem.states_at(before.path, grid.start_sample)
            problem.guess_from(before.problem, before.path)
        if self.patient and self.hurried:  # the start alone is stepped through: trials without a path may be left
            problem.solve(problem.pack(start, states))
        problem.patient = self.patient and not self.hurried
        name = f"segments of {length}" + (", robust" if freedom else "" if used is None else ", outliers left out")
        return self.optimise(problem, start, states, name, near=near)

    def optimise(
        self, problem: ShootingProblem, theta: Tensor, states: Tensor, name: str, *, near: bool = False
    ) -> TrajectoryFit | None:
        """Minimise from these parameters and segment states, `near` the minimum or not; None where no path is found."""
        target = StatesOnly(problem, theta) if self.frozen else problem
        x = states.reshape(-1) if self.frozen else problem.pack(theta, states)
        total, whole = min(self.task.config.iterations, STAGE), problem.grid.segments == len(self.task.data)
        early = self.hurried and (self.frozen or self.compared or not whole)
        rtol, patience = (1e-2, 1) if early else (1e-3 if self.many else 1e-4, 3)
        result = self.task.stages.run(
            name + self.label, x, total,
            lambda x, callback: levenberg_marquardt(
                target, x, max_iterations=total, rtol=rtol, patience=patience, damping=NEAR if near else FAR_OFF,
                callback=callback,
            ),
            problem,
        )  # fmt: skip
        if not self.frozen:
            theta = problem.unpack(result.x)[0]
        path = problem.solve(problem.pack(theta, result.x[-states.numel() :].reshape(states.shape)))
        return None if path is None or not math.isfinite(result.cost) else TrajectoryFit(theta, problem, path, result)

    def shortest(self, sigma: float) -> TrajectoryFit | None:
        """The shortest segments, from the samples."""
        return self.fit(self.lengths[0], sigma, FREEDOM if self.task.config.robust == "on" else None, None)

    def robust_or_not(self, first: TrajectoryFit, *, known: bool = False) -> TrajectoryFit:
        """The shortest segments, with Student's t or without the outliers where the data have any.

        With `robust` "auto" they are fitted with Student's t as well. Where that shows outliers, and they are few, they
        are left out and least squares go on with the rest; where the rest has outliers still, or they are many,
        Student's t is the loss of all further stages (`problems.robust`). Where the model is `known` already, outliers
        cannot hide in a poor fit: they show in its residuals.
        """
        plain = first.noise < FLOOR * self.task.size or not heavy_tailed(first.misfit)
        if self.task.config.robust != "auto" or (known and plain):
            return first
        trial = self.fit(self.lengths[0], max(scale_of(first.misfit), 1e-3 * FLOOR * self.task.size), FREEDOM, None)
        if trial is None or not heavy_tailed(trial.misfit):
            return first
        return self._without_outliers(trial) or trial

    def _without_outliers(self, trial: TrajectoryFit) -> TrajectoryFit | None:
        """The same segments by least squares without the samples far from the robust fit; None if outliers remain.

        A heavy-tailed loss finds outliers, but fits what is left less well than least squares do (reweighted least
        squares, Rousseeuw & Leroy 1987). A push breaks a joint, and no sample that is left out can mend it.
        """
        out = torch.zeros_like(trial.problem.used)
        out[trial.problem.data.complete] = far_out(trial.misfit)
        if float(out.double().mean()) > FEW:
            return None
        rest = self.fit(self.lengths[0], trial.noise, None, trial, ~out)
        if rest is None or heavy_tailed(rest.misfit):
            return None
        return None if float(rest.problem.joint_residuals(rest.path, rest.theta).abs().max()) > FAR else rest

    def at_once(self, sigma: float) -> TrajectoryFit | None:
        """Whole trajectories from parameters that are known; None where no path is found.

        The states alone are fitted first: together with them, parameters would make up for poor starts.
        """
        states = SegmentStages(self.task, self.model, frozen=True, label=f", states{self.label}")
        states.patient, states.hurried, self.patient = False, True, False
        before = states.fit(self.lengths[-1], sigma, None, None)
        near = not self.model.capabilities.sticking  # its kinks leave Newton's steps no descent
        found = None if before is None else self.fit(self.lengths[-1], sigma, None, before, near=near)
        self.patient = True
        return found

    def whole(self, first: TrajectoryFit, sigma: float) -> TrajectoryFit | None:
        """Whole trajectories at once, from parameters that are known well; None where that misses far more than σ."""
        used = None if bool(first.problem.used.all()) else first.problem.used
        found = self.fit(self.lengths[-1], first.noise, first.problem.freedom, first, used)
        most = LOST * max(first.noise, sigma, FLOOR * self.task.size)
        return None if found is None or found.noise > most else found

    def grow(self, first: TrajectoryFit, sigma: float) -> TrajectoryFit:
        """From the shortest segments to whole trajectories, or as long as the model follows the data."""
        last, best = first, first.noise
        freedom = first.problem.freedom
        used = None if bool(first.problem.used.all()) else first.problem.used
        followed = 0.0
        if self.model.capabilities.sticking:  # no restoring force: errors grow with the length, and are the objective
            followed = FOLLOWED * spread(self.task.data)
        for length in self.lengths[1:]:
            if not self.frozen:
                sigma = last.noise if freedom else max(sigma, last.noise)
            longer = self.fit(length, sigma, freedom, last, used)
            most = max(LOST * max(best, FLOOR * self.task.size), followed)
            if longer is None or (not self.frozen and longer.noise > most):
                break  # no parameters follow the data for so long: chaos, or forces that the model does not know
            last, best = longer, min(best, longer.noise)
        return last


def fit_states(task: Task, model: ContactLagrangian, sigma: float, s: Tensor | None = None) -> TrajectoryFit | None:
    """The states of the data with the parameters held; None if the model follows not even the shortest segments."""
    stages = SegmentStages(task, model, frozen=True, s=s)
    first = stages.fit(stages.lengths[0], sigma, None, None)
    return None if first is None else stages.grow(first, sigma)


def fit_trajectories(task: Task, model: ContactLagrangian, sigma: float, *, known: bool = False) -> Chosen | None:
    """Fit parameters and states to positions.

    Segments grow from 20 steps to whole trajectories, or as long as the model follows the data, each stage started from
    the states of the one before. Then every prior strength is fitted in turn, the weakest first: its residuals give the
    noise that all strengths are fitted with. The strongest prior whose held-out error is not beaten beyond its spread
    wins. Of many coordinates the strongest is first, and the only one where blocks that are held out are missed by more
    than the motion's spread: too few samples for so many parameters. A model that is `known` from an earlier fit needs
    no growing: whole trajectories follow the shortest segments.
    The result is from the longest segments that could be fitted; None if the model cannot follow even the shortest.
    """
    if model.potential.network is None:  # there is no strength of a prior to choose
        departure = task.config.departures[0]
        task = replace(task, config=replace(task.config, departures=(departure,)))
        _, last = _longest(task, model, sigma, known=known)
        return None if last is None else Chosen(last, departure, {departure: last.held_out_errors()})
    stages, last = _longest(task, model, sigma, known=known)
    if last is None:
        return None
    departures = stages.task.config.departures
    previous, noise = last, last.noise
    stages.hurried = task.hurried and not stages.many  # strengths are compared by fits that have ended

    def fit(name: str, departure: float) -> TrajectoryFit | None:
        nonlocal previous
        old = previous.problem
        problem = ShootingProblem(
            model, task.data, old.grid, sigma=noise, prior=prior_of(model, task.base, departure), freedom=old.freedom,
            used=old.used,
        )  # fmt: skip
        problem.path = previous.path  # the same segments
        states = problem.states_at(previous.path, old.grid.start_sample)
        found = stages.optimise(problem, previous.theta, states, name)
        previous = found or previous
        return found

    if stages.many:  # fits of strengths that held-out blocks cannot tell apart would be waited for in vain
        least = min(departures)
        strongest = fit("strongest prior", least)
        held_out = {} if strongest is None else {least: strongest.held_out_errors()}
        if strongest is not None and float(held_out[least].square().mean().sqrt()) > spread(task.data):
            return Chosen(strongest, least, held_out)
    # The weakest prior twice: the first round finds the noise, which then stays the same for all.
    noise = (fit("noise", max(departures)) or last).noise
    fits, held_out = {}, {}
    for departure in sorted(departures, reverse=True):
        if (found := fit(f"prior {departure:g}", departure)) is not None:
            fits[departure], held_out[departure] = found, found.held_out_errors()
    if not fits:
        return Chosen(last, departures[0], {})
    strongest = simplest_not_beaten(held_out)
    return Chosen(fits[strongest], strongest, held_out)


def _longest(
    task: Task, model: ContactLagrangian, sigma: float, *, known: bool
) -> tuple[SegmentStages, TrajectoryFit | None]:
    """The fit to segments that are as long as the model follows, by the loss that the data call for, with its stages.

    Of a model that is known whole trajectories by least squares are first. A heavy-tailed loss replaces them where it
    lets no data go that they follow: the tails may be those of what the model misses.
    """
    plain, known_stages = None, SegmentStages(task, model)
    if known and task.config.robust != "on":
        known_to = max(sigma, FLOOR * task.size)
        plain = known_stages.at_once(known_to)
        tails = plain is not None and task.config.robust != "off" and heavy_tailed(plain.misfit)
        if plain is not None and plain.follows(known_to) and not tails:
            return known_stages, plain
    stages, first = _wide_enough(task, model, sigma)
    if first is None:
        return known_stages, plain
    first = stages.robust_or_not(first, known=known)
    at_once = known or model.potential.network is None
    last = stages.whole(first, sigma if known else 0.0) if at_once else None
    last = last or stages.grow(first, sigma)
    return (stages, last) if plain is None or not last.loses(plain) else (known_stages, plain)


def _wide_enough(task: Task, model: ContactLagrangian, sigma: float) -> tuple[SegmentStages, TrajectoryFit | None]:
    """The stages whose range of priors lets the shortest segments follow the data, and the fit of these segments.

    The range of the settings, if these segments are at the data's precision or miss less than 1 % of the motion. If
    not, ranges weaker by 30 and 900 are tried, and taken where they halve the error: the baseline then lacks a force as
    large as its own. Errors are those of the bulk, for outliers are no reason for another prior.
    """
    stages = SegmentStages(task, model)
    first = stages.shortest(sigma)
    enough = max(NOT_THE_NOISE * precision(task.data), SMALL * task.size)
    for by in WIDER if len(task.config.departures) > 1 else ():
        if first is not None and scale_of(first.misfit) <= enough:
            break
        weaker = tuple(departure * by for departure in task.config.departures)
        wide = replace(task, config=replace(task.config, departures=weaker))
        other = SegmentStages(wide, model, label=f", prior weaker by {by:g}")
        found = other.shortest(sigma)
        if found is not None and (first is None or scale_of(found.misfit) < scale_of(first.misfit) / HALVED):
            stages, first = other, found
    return stages, first
