"""Fit noisy trajectories by multiple shooting: segments grow, then held-out errors choose the strength of the prior."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.data.noise import precision, spread
from herglotz.data.smoothing import smoothed
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

# The first segments have so few recorded steps that their motion is almost linear in states and forces.
SHORT_SEGMENTS = (5, 10)
# Segments stop growing if their error exceeds this multiple of the error of shorter segments.
LOST = 2.0
# Segments of a sticking model grow further as long as their error is below this share of the spread of q: without a
# restoring force errors grow with the length, and the simulation error is the objective.
FOLLOWED = 0.05
# Shares of the largest |q|. An error below FLOOR does not stop the growth of segments. If the shortest segments miss
# less than SMALL, no force as large as the baseline's is missing.
FLOOR, SMALL = 1e-6, 1e-2
# Factors on the prior strengths: the first range starts where the default one ends, the second at 5 baseline forces.
# A weaker prior has to halve the error of the shortest segments.
WEAKER, HALVED = (30.0, 900.0), 2.0
# A misfit above this multiple of the data's precision is not the noise, as in the verdict.
NOT_THE_NOISE = 1.5
# The first iteration has this damping λ: near the minimum, steps are Newton's.
FAR_OFF, NEAR = 1e-3, 1e-8
# A stage has at most this many iterations: a start near the optimum needs fewer, and a later stage improves the rest.
STAGE = 40
# Stages of compiled models whose motion depends on s have more iterations: rates and s can make up for one another, so
# that steps are many and small.
STAGE_WITH_S = 200
# With more than four coordinates an iteration takes up to 0.2 s, and gains of 1e-4 would take minutes.
MANY_COORDINATES = 4


@dataclass(frozen=True)
class TrajectoryFit:
    """Fitted parameters and segment states, for one length of the segments and one strength of the prior."""

    theta: Tensor  # (P,)
    problem: ShootingProblem
    path: Path
    result: OptimiserResult

    @property
    def misfit(self) -> Tensor:
        """Residuals of the complete samples in use, (N', n), in units of q over the balance."""
        return self.problem.misfit(self.path)[self.problem.used & self.problem.data.complete]

    @property
    def noise(self) -> float:
        """Scale of the residuals, in units of q over the balance: RMS, or a robust scale."""
        return scale_of(self.misfit) if self.problem.freedom else float(self.misfit.square().mean().sqrt())

    @property
    def used(self) -> Tensor | None:
        """Samples in use, (N,) bool; None for all."""
        return None if bool(self.problem.used.all()) else self.problem.used

    def states(self) -> Tensor:
        """The fitted trajectory at the samples, (N, 2n+1)."""
        return self.problem.grid.at_samples(self.path.x)

    def held_out_errors(self) -> Tensor:
        """RMS error of every held-out block, in units of q (`cross_validation.held_out_errors`)."""
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
    """Fits of one model at growing segment lengths, from its current parameters; `frozen` fits only the states.

    `s` (N,) is s at every sample in the model's unit, if known; `label` ends the names of these stages, which have to
    be unique in a fit.
    """

    def __init__(
        self, task: Task, model: ContactLagrangian, *, frozen: bool = False, s: Tensor | None = None, label: str = ""
    ):
        self.task, self.model, self.frozen, self.s, self.label = task, model, frozen, s, label
        lengths = segment_lengths(task.data)
        self.lengths = [length for length in lengths if not task.longest or length <= task.longest] or lengths[:1]
        # If no path is known, a patient fit steps through the trajectory for every trial.
        self.patient, self.many = True, task.data.dof > MANY_COORDINATES
        # A hurried stage that is not the last, or that fits only states, ends when an iteration gains less than 1 %.
        self.hurried = task.hurried or self.many
        # If priors are compared later, no stage here is the last.
        self.compared = self.many and model.potential.network is not None

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
        """Segments of one length, from the states of the fit `before` or of the data; None if no path is found.

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
            # Two equal readings are a joint that friction holds, whose motion has no slope by its momentum.
            smooth = smoothed(task.data) if self.model.capabilities.sticking else None
            states = first_states(problem, start, smooth)
            problem.guess_from_states(states_of_pairs(self.model, task.data))
        else:
            start, states = before.theta, before.problem.states_at(before.path, grid.start_sample)
            problem.guess_from(before.problem, before.path)
        # A hurried fit steps only through the start; trials without a path are rejected.
        if self.patient and self.hurried:
            problem.solve(problem.pack(start, states))
        problem.patient = self.patient and not self.hurried
        name = f"segments of {length}" + (", robust" if freedom else "" if used is None else ", outliers left out")
        return self.optimise(problem, start, states, name, near=near)

    def optimise(
        self, problem: ShootingProblem, theta: Tensor, states: Tensor, name: str, *, near: bool = False
    ) -> TrajectoryFit | None:
        """Minimise from these parameters and segment states, `near` the minimum or not; None if no path is found."""
        target = StatesOnly(problem, theta) if self.frozen else problem
        x = states.reshape(-1) if self.frozen else problem.pack(theta, states)
        most = STAGE_WITH_S if self.model.s_enters_motion and problem.compiled is not None else STAGE
        total, whole = min(self.task.config.iterations, most), problem.grid.segments == len(self.task.data)
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
        """The shortest segments, from states read off the samples."""
        return self.fit(self.lengths[0], sigma, FREEDOM if self.task.config.robust == "on" else None, None)

    def from_least_squares(self, sigma: float, freedom: float | None) -> TrajectoryFit | None:
        """The shortest segments by Student's t of this freedom (None: by least squares), from those by least squares.

        A heavy-tailed loss finds no way from states that are off by many deviations, as those read off exact samples.
        Least squares find none where motion over a segment is far from linear in its start; they begin with short ones.
        """
        found = None
        for length in (*(x for x in SHORT_SEGMENTS if x < self.lengths[0]), self.lengths[0]):
            found = self.fit(length, sigma, None, found)
        return found if found is None or freedom is None else self.fit(self.lengths[0], sigma, freedom, found)

    def robust_or_not(self, first: TrajectoryFit, *, known: bool = False) -> TrajectoryFit:
        """The shortest segments: `first`, or if the data have outliers, a fit without the outliers or by Student's t.

        With `robust` "auto" the segments are fitted by Student's t as well. A few outliers in its residuals are left
        out, and least squares continue with the rest. If the outliers are many, or the rest still has outliers,
        Student's t is the loss of all further stages (`problems.robust`). A `known` model fits well: outliers then show
        in the residuals of `first`, and no second fit looks for them.
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

        A heavy-tailed loss finds outliers, but least squares fit the rest better (reweighted least squares, Rousseeuw &
        Leroy 1987). A push of the system leaves a large residual at a joint of segments, whatever sample is left out.
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
        """Whole trajectories from known parameters; None if no path is found.

        The states are fitted first, with the parameters fixed: else the parameters would compensate poor start states.
        """
        states = SegmentStages(self.task, self.model, frozen=True, label=f", states{self.label}")
        states.patient, states.hurried, self.patient = False, True, False
        before = states.fit(self.lengths[-1], sigma, None, None)
        # With the kinks of set-valued friction an undamped Newton step may not descend.
        near = not self.model.capabilities.sticking
        found = None if before is None else self.fit(self.lengths[-1], sigma, None, before, near=near)
        self.patient = True
        return found

    def all_followed(self, sigma: float) -> TrajectoryFit | None:
        """Whole trajectories from states of the data, or None if the error of one of them exceeds σ by far.

        Growth to whole trajectories takes five times as long.
        """
        found, data = self.fit(self.lengths[-1], sigma, None, None), self.task.data
        if found is None:
            return None
        most = LOST * max(sigma, FLOOR * self.task.size)
        missed = zip(
            found.problem.misfit(found.path).split(data.lengths), data.complete.split(data.lengths), strict=True
        )
        return found if all(float(own[there].square().mean().sqrt()) <= most for own, there in missed) else None

    def whole(self, first: TrajectoryFit, sigma: float) -> TrajectoryFit | None:
        """Whole trajectories at once, from the fit `first`; None if the error exceeds twice that of `first` and σ."""
        found = self.fit(self.lengths[-1], first.noise, first.problem.freedom, first, first.used)
        most = LOST * max(first.noise, sigma, FLOOR * self.task.size)
        return None if found is None or found.noise > most else found

    def grow(self, first: TrajectoryFit, sigma: float) -> TrajectoryFit:
        """From the shortest segments to whole trajectories, or to the longest that the model follows."""
        last, best, freedom = first, first.noise, first.problem.freedom
        followed = FOLLOWED * spread(self.task.data) if self.model.capabilities.sticking else 0.0
        for length in self.lengths[1:]:
            if not self.frozen:
                sigma = last.noise if freedom else max(sigma, last.noise)
            longer = self.fit(length, sigma, freedom, last, first.used)
            most = max(LOST * max(best, FLOOR * self.task.size), followed)
            # Beyond this length no parameters follow the data: chaos, or forces that the model lacks.
            if longer is None or (not self.frozen and longer.noise > most):
                break
            last, best = longer, min(best, longer.noise)
        return last


def fit_states(task: Task, model: ContactLagrangian, sigma: float, s: Tensor | None = None) -> TrajectoryFit | None:
    """States of the data with fixed parameters; None if the model does not follow even the shortest segments."""
    stages = SegmentStages(task, model, frozen=True, s=s)
    first = stages.fit(stages.lengths[0], sigma, None, None)
    return None if first is None else stages.grow(first, sigma)


def fit_trajectories(task: Task, model: ContactLagrangian, sigma: float, *, known: bool = False) -> Chosen | None:
    """Fit parameters and states to positions.

    Segments grow from 20 steps to whole trajectories, or to the longest that the model follows (None: it does not
    follow even the shortest); each stage starts from the states of the stage before. Then every prior strength is
    fitted in turn, first the weakest, whose residuals give the noise level for all. The strongest prior wins whose
    held-out error is not beaten beyond its spread. With many coordinates the strongest is fitted first, and is the only
    one if its held-out error exceeds the spread of the motion: too few samples for the parameters. A model that is
    `known` from an earlier fit skips the growth: whole trajectories follow the shortest segments.
    """
    # Without a network there is no strength of a prior to choose.
    if model.potential.network is None:
        task = replace(task, config=replace(task.config, departures=task.config.departures[:1]))
    stages, last = _longest(task, model, sigma, known=known)
    if last is None:
        return None
    if model.potential.network is None:
        departure = stages.task.config.departures[0]
        return Chosen(last, departure, {departure: last.held_out_errors()})
    # Only converged fits are compared.
    stages.hurried = task.hurried and not stages.many
    return _of_best_prior(stages, last)


def _of_best_prior(stages: SegmentStages, last: TrajectoryFit) -> Chosen:
    """The fit with the strength of the prior that held-out blocks choose, over the segments of the fit `last`."""
    task, departures = stages.task, stages.task.config.departures
    previous, noise = last, last.noise

    def fit(name: str, departure: float) -> TrajectoryFit | None:
        nonlocal previous
        old, prior = previous.problem, prior_of(stages.model, task.base, departure)
        problem = ShootingProblem(
            stages.model, task.data, old.grid, sigma=noise, prior=prior, freedom=old.freedom, used=old.used
        )
        problem.path = previous.path
        states = problem.states_at(previous.path, old.grid.start_sample)
        found = stages.optimise(problem, previous.theta, states, name)
        previous = found or previous
        return found

    # With many coordinates each strength takes minutes: the others are skipped if held-out blocks cannot compare them.
    if stages.many:
        least = min(departures)
        strongest = fit("strongest prior", least)
        held_out = {} if strongest is None else {least: strongest.held_out_errors()}
        if strongest is not None and float(held_out[least].square().mean().sqrt()) > spread(task.data):
            return Chosen(strongest, least, held_out)
    # The weakest prior is fitted twice: the first fit measures the noise, which then is the same for all strengths.
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
    """The fit to the longest segments that the model follows, with its stages; its loss is robust if need be.

    A known model is first fitted to whole trajectories by least squares. The fit by a heavy-tailed loss takes the place
    of this fit unless it gives up samples that least squares follow: the tails are then errors of the model.
    """
    plain, plain_stages = None, SegmentStages(task, model)
    if known and task.config.robust != "on":
        least = max(sigma, FLOOR * task.size)
        plain = plain_stages.at_once(least)
        tails = plain is not None and task.config.robust != "off" and heavy_tailed(plain.misfit)
        if plain is not None and plain.noise <= LOST * least and not tails:
            return plain_stages, plain
    stages, first = _wide_enough(task, model, sigma)
    if first is None:
        return plain_stages, plain
    first = stages.robust_or_not(first, known=known)
    skips_growth = known or model.potential.network is None
    last = (stages.whole(first, sigma if known else 0.0) if skips_growth else None) or stages.grow(first, sigma)
    if plain is None:
        return stages, last
    robust_rms, plain_rms = (float(fit.misfit.square().mean().sqrt()) for fit in (last, plain))
    return (stages, last) if robust_rms <= NOT_THE_NOISE * plain_rms else (plain_stages, plain)


def _wide_enough(task: Task, model: ContactLagrangian, sigma: float) -> tuple[SegmentStages, TrajectoryFit | None]:
    """Stages with a prior weak enough for the shortest segments to follow the data, and the fit of these segments.

    The strengths of the settings suffice if the error is near the data's precision or below 1 % of the motion. If not,
    priors weaker by 30 and 900 are tried, and taken if they halve the error: the baseline then lacks a force as large
    as its own. Errors are median absolute deviations, because outliers are no reason for another prior.
    """
    stages = SegmentStages(task, model)
    first = stages.shortest(sigma)
    enough = max(NOT_THE_NOISE * precision(task.data), SMALL * task.size)
    for by in WEAKER if len(task.config.departures) > 1 else ():
        if first is not None and scale_of(first.misfit) <= enough:
            break
        weaker = tuple(departure * by for departure in task.config.departures)
        wide = replace(task, config=replace(task.config, departures=weaker))
        other = SegmentStages(wide, model, label=f", prior weaker by {by:g}")
        found = other.shortest(sigma)
        if found is not None and (first is None or scale_of(found.misfit) < scale_of(first.misfit) / HALVED):
            stages, first = other, found
    return stages, first
