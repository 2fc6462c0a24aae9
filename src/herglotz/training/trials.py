"""Trials, the fitted models of a search, and the fitter that fits any subset of a dictionary's parameters.

A model is a set of offers (`offers`), fitted by multiple shooting over segments that grow while the model follows the
data.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.input_terms import input_terms_of
from herglotz.data.noise import AT_THE_NOISE, coarse, precision, precisions, relative_spread
from herglotz.data.smoothing import slopes, smoothed
from herglotz.models.features import windings
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.coupled_pairs import groups
from herglotz.training.dictionary import keys_of
from herglotz.training.errors_of_runs import EXACT_ENOUGH
from herglotz.training.first_states import first_states, states_of_pairs
from herglotz.training.functions import Band, prior_spreads, terms_with
from herglotz.training.held_out import HeldOut
from herglotz.training.named_terms import (
    DRY,
    NamedTerms,
    candidates,
    own_terms,
    settings_of,
    started,
    turns_one_way,
)
from herglotz.training.offers import ALWAYS, TILT, offers_of, without_offers
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import Grids, segment_lengths
from herglotz.training.problems.prior import Gaussian, prior_of
from herglotz.training.problems.robust import scale_of
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.score import Score, are_white, fitted_score, free_run_score, scores
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt
from herglotz.training.solvers.lifted_newton import Path
from herglotz.training.task import EXACT, build_model, with_sticking
from herglotz.training.trajectory_fit import FAR_OFF, FOLLOWED, LOST, NEAR, SHORT_SEGMENTS

# Iterations of a fit; a trial that needs more starts too far from its optimum.
ITERATIONS = 15
# Share of every trajectory to which finalists are fitted; they run free over the rest.
FITTED_SHARE = 0.75
# A model does not follow segments if its misfit exceeds this share of the spread of the data.
MAX_MISFIT = 0.25
# Halved model steps are tried if they change the motion by more than this share of the misfit.
FINER = 0.3
# A misfit below this many σ of exact data is rounding.
ALIKE = 10.0
# A rule of order 4 is worth its time if the noise is below this share of the spread of the data.
ORDER_4_NOISE = 1e-3
# Largest number of model steps in a recorded step, and in all trajectories.
MAX_SUBSTEPS, MAX_STEPS = 64, 64_000


@dataclass(frozen=True)
class Variant:
    """Order and steps of the rule, kind of dry friction, and the dictionary of a model.

    `functions` are bands of learned functions beside the named terms. `dissipation` are powers of s in L. `kept` are
    named terms that stay offers although functions can replace them. With `windings` torsion springs between joints
    are offers.
    """

    order: int
    substeps: int = 1
    sticking: bool = False
    functions: tuple[Band, ...] = ()
    dissipation: tuple[str, ...] = ()
    kept: frozenset[str] = frozenset()
    windings: bool = False

    def crossing(self, ratio: float) -> Variant:
        """The variant with model steps of about the same length for recorded steps that are `ratio` times as long."""
        return replace(self, substeps=max(1, round(ratio * self.substeps)))


class Compared(NamedTuple):
    """A scored model: segments of `length` recorded steps, number of parameters, RMS error, and offers.

    `held_out` is the error over held-out blocks, in units of q over the balance.
    """

    length: int
    numbers: int
    held_out: float
    taken: frozenset[str]


@dataclass(frozen=True)
class Trial:
    """A fitted model: the offers `taken` by the model, the `values` of all numbers of the dictionary, and the path.

    `scales` are the prior variances of the model's functions over those of the fitter.
    """

    fitter: Fitter
    taken: frozenset[str]
    values: dict[str, float]
    problem: ShootingProblem
    path: Path
    scales: Mapping[str, float] = field(default_factory=dict)

    @property
    def theta(self) -> Tensor:
        """Values of the free parameters, (P,)."""
        return self.path.x.new_tensor([self.values[name] for name in self.problem.parameters.numbers])

    @cached_property
    def rms(self) -> float:
        """RMS misfit of the data, in units of q over the balance; a robust scale if the loss is Student's t."""
        r = self.problem.misfit(self.path)[self.problem.data.complete]
        return scale_of(r) if self.problem.freedom else float(r.square().mean().sqrt())

    @property
    def names(self) -> list[str]:
        """Names of the offers of the model, in the order of the dictionary."""
        return [offer.name for offer in (*self.fitter.offers, *self.fitter.loads) if offer.name in self.taken]

    @property
    def injecting_friction(self) -> dict[str, int]:
        """Dry friction with an amplitude of 0 or less, which would inject energy: name → coordinate."""
        several = self.fitter.data.dof > 1
        amplitudes = {DRY + (f"[{i}]" if several else ""): i for i in range(self.fitter.data.dof)}
        return {name: i for name, i in amplitudes.items() if name in self.taken and self.values[name] <= 0}

    @property
    def length(self) -> int:
        """Length of the fitted segments, in recorded steps."""
        return self.problem.grid.length

    @property
    def whole(self) -> bool:
        """True if the segments of the fit are whole trajectories."""
        return not self.problem.jointed

    @property
    def near(self) -> bool:
        """True if the linearised motion of whole trajectories is close enough to the data to predict good offers."""
        return self.whole and self.rms <= FOLLOWED * self.fitter.spread

    @property
    def followed(self) -> float:
        """Largest misfit with which the model follows longer segments, or equally long segments of other data."""
        spread = self.fitter.spread
        return min(max(LOST * self.rms, FOLLOWED * spread), MAX_MISFIT * spread)

    @property
    def at_the_noise(self) -> bool:
        """True if the misfit of whole trajectories is about the noise of the data."""
        return self.whole and self.segments_at_the_noise

    @property
    def segments_at_the_noise(self) -> bool:
        """True if the misfit of the segments is about the noise of the data."""
        return self.rms <= self.fitter.about_the_noise

    @property
    def misses_next_to_nothing(self) -> bool:
        """True if the misfit of whole trajectories is too small to matter."""
        return self.whole and self.rms <= EXACT_ENOUGH * self.fitter.spread

    @cached_property
    def unstable(self) -> bool:
        """True if the misfit of the samples is about the noise, and the start of longer segments would be `lost`.

        The residuals of joints do not count: if the motion is unstable, they are the misfit of the segments' ends.
        """
        if self.whole or not self.lost:
            return False
        r = self._held_out.fitted_residuals([range(self.problem.P)])[0][self.problem.data.complete]
        return float(r.square().mean().sqrt()) <= self.fitter.about_the_noise

    @cached_property
    def lost(self) -> bool:
        """True if an error of the start as small as the noise grows to the spread of the motion in longer segments.

        The linearised steps of this model carry the error through two successive segments. If the motion is so
        unstable, longer segments cannot distinguish a wrong start from a wrong force. False if the noise is unknown.
        """
        problem, grid, data = self.problem, self.problem.grid, self.problem.data
        if self.whole or not math.isfinite(self.fitter.precision):
            return False
        n, d, spread = problem.n, problem.d, data.q.std(0, correction=0).clamp_min(1e-300)[:, None]
        noise = (precisions(data).to(data.q) * data.balance).diag()  # (n, n)

        def size(error: Tensor) -> Tensor:
            return (error / spread).square().sum((-2, -1)).div(n).sqrt().nan_to_num(torch.inf)

        slopes, ends = problem.slopes_by_start(self.theta, self.path)
        # Growth by a factor G in one segment is growth by about G² in two, and slower growth is less.
        if float(size(slopes[..., :n] @ noise).max()) ** 2 < float(size(noise)):
            return False
        first = torch.cat([noise, noise.new_zeros(d - n, n)]).expand(grid.segments, d, n)
        first = torch.where(grid.joined[:, None, None], (ends @ first).roll(1, 0), first)
        return bool((size(slopes @ first[grid.segment]) >= 1).any())

    @cached_property
    def lacks_nothing(self) -> bool:
        """True if the misfit of whole trajectories is about the noise and white, or too small to matter."""
        return self.at_the_noise and (self.misses_next_to_nothing or are_white(self.problem, self.path))

    @cached_property
    def _held_out(self) -> HeldOut:
        """The fit linearised, with held-out blocks of time."""
        waves = self.fitter.waves(self.prior, self.problem.parameters.numbers)
        return HeldOut(self.problem, self.path, self.theta, waves=waves)

    @cached_property
    def _scores(self) -> dict[float, Score]:
        """The scores computed so far, by their floor."""
        return {}

    @property
    def score(self) -> Score:
        """Score over held-out blocks; computing the score records the model in `Fitter.compared`."""
        return self.score_above(self.fitter.floor)

    def score_above(self, floor: float) -> Score:
        """The score with residuals below this floor taken for rounding."""
        if floor not in self._scores:
            count, choices = int((self.problem.weight > 0).sum()), [len(self.taken)]
            (found,) = scores(self._held_out, [range(self.problem.P)], choices, count, floor)
            self.fitter.compared.append(Compared(self.length, self.problem.P, found.rms, self.taken))
            self._scores[floor] = found
        return self._scores[floor]

    @cached_property
    def _shorter(self) -> dict[int, Trial | None]:
        """The models over shorter segments fitted so far, by the length of their segments."""
        return {}

    def over(self, length: int) -> Trial | None:
        """The model over shorter segments (`Fitter.over`), fitted once for every length."""
        if length not in self._shorter:
            self._shorter[length] = self.fitter.over(self, length)
        return self._shorter[length]

    def replaces(self, simple: Trial) -> bool:
        """True if this richer model replaces a simpler model."""
        return self.gain(simple) > 0

    def gain(self, simple: Trial, more: int = 0) -> float:
        """`Score.gain` over a simpler model, with `more` further numbers; ±infinite if segments differ in length.

        The model that follows longer segments is better, as far as noise lets them be followed (`of_one_length`).
        """
        if (pair := of_one_length(self, simple)) is None:
            return math.inf if self.length > simple.length else -math.inf
        rich, other = scores_of(*pair)
        return replace(rich, zeros=more).gain(other, max(self.fitter.offered, simple.fitter.offered))

    def foretells(self, other: Trial) -> bool:
        """True if this model misses held-out blocks clearly less than another, whatever the numbers of both cost.

        The model that follows longer segments is better, as far as noise lets them be followed (`of_one_length`).
        """
        if (pair := of_one_length(self, other)) is None:
            return self.length > other.length
        own, theirs = scores_of(*pair)
        return own.clearly_better(theirs)

    def fits_better(self, simple: Trial, zeros: int = 0) -> bool:
        """True if this model, with `zeros` of sensors as further numbers, replaces a model with the same offers.

        By the residuals of both fits (`fitted_score`); the model that follows longer segments is better, as far as
        noise lets them be followed (`of_one_length`).
        """
        if (pair := of_one_length(self, simple)) is None:
            return self.length > simple.length
        (rich, other), floor = pair, max(self.fitter.floor, simple.fitter.floor)
        theirs = fitted_score(other.problem, other.path, floor)
        own = fitted_score(rich.problem, rich.path, floor, zeros)
        return own.replaces(theirs, self.fitter.offered)

    @property
    def prior(self) -> Gaussian:
        """Prior of the free parameters."""
        assert isinstance(self.problem.prior, Gaussian)
        return self.problem.prior

    @cached_property
    def likeliest_scales(self) -> dict[str, float]:
        """Likeliest prior variance of each function, over the variance in the fitter (evidence, MacKay 1992)."""
        numbers, found = self.problem.parameters.numbers, {}
        place = {name: i for i, name in enumerate(numbers)}
        places = {name: [place[x] for x in waves if x in place] for name, waves in self.fitter.functions.items()}
        if not any(places.values()):
            return {}
        weight = self.fitter.prior(numbers).weight
        # Share of each parameter that the data determine.
        (share,) = self._held_out.told([range(self.problem.P)])
        for name, at in places.items():
            size = float((self.theta[at].square() * weight[at]).sum()) / max(float(share[at].sum()), 1.0)
            if size > 0:
                found[name] = size
        return found


class Fitter:
    """Fits of subsets of a dictionary's parameters to recordings, for one variant of the model.

    `like` is another fitter of the same data, which shares its segments and noise levels. A recorded step has at most
    `finest` model steps. Numbers are scalar parameters, by name; `keys` has the term of each number. Features in the
    settings take the place of `candidates`, whose `ratios` are the argument of that name.
    """

    def __init__(
        self, grids: Grids, base: Baseline, config: FitConfig, variant: Variant, freedom: float | None,
        like: Fitter | None = None, ratios: Mapping[tuple[int, int], str] | None = None,
    ):  # fmt: skip
        data = grids.data
        self.grids, self.data, self.variant, self.freedom = grids, data, variant, freedom
        self.finest = max(1, min(MAX_SUBSTEPS, MAX_STEPS // data.samples))
        bands = variant.functions
        self.terms = terms = _terms(data, config, variant, ratios)
        settings = replace(settings_of(terms, data, config, variant.order, variant.substeps), sticking=variant.sticking)
        known = (smoothed(data), precision(data), relative_spread(data)) if like is None else like.known
        self.known = self.smooth, self.precision, self.spread = known
        first = {"damping.rate": (base.rate,), "kinetic.base.log_diagonal": masses(self.smooth)}
        base = started(base, data, first, settings)
        self.base, self.settings = base, settings
        model = build_model(base, settings, "none")
        self.model = with_sticking(model, excess=False) if variant.sticking else model
        every = ParameterVector(self.model)
        self.keys = dict(zip(every.numbers, keys_of(every.numbers, self.model.config), strict=True))
        self.always, every_offer, self.simple = offers_of(
            self.model, list(self.keys.values()), bands, len(input_terms_of(data.columns))
        )
        fixed = _undetermined_masses(data, config)
        self.always = tuple(name for name in self.always if name not in fixed)
        without_offers(self.model, every_offer)
        # On a joint that turns one way, a load is the same force as dry friction, which is offered already.
        one_way = [f"load {i + 1}" for i in range(data.dof) if turns_one_way(data, i)]
        self.offers = [offer for offer in every_offer if offer.name not in one_way]
        self.loads = [offer for offer in every_offer if offer.name in one_way]
        self.start = dict(zip(every.numbers, every.get().tolist(), strict=True))
        self.place = {key: name for name, key in self.keys.items()}
        # Names of the coefficients of the waves of each function.
        self.functions = {band.name: [self.place[text] for text in band.texts] for band in bands}
        self.weights, self.centred = self._weights(every.numbers)
        lengths = segment_lengths(data)
        self.lengths = [*(length for length in SHORT_SEGMENTS if length < lengths[0]), *lengths]
        self.problems: dict[int, ShootingProblem] = {}
        self.rounding = ALIKE * EXACT["float64"] * max(base.scale)
        # Misfit that the error of the finest steps explains, by the order of the rule.
        self.of_steps: dict[int, float] = {} if like is None else like.of_steps
        self.offered = len(every_offer)
        self.compared: list[Compared] = []

    @property
    def constant_forces(self) -> set[str]:
        """Names of the offers of a force at rest, which a zero of the sensor can imitate."""
        own = {key for key, (parameter, _) in own_terms(self.data.angles).items() if parameter == TILT}
        return own.union(key for number, key in self.keys.items() if number.startswith(TILT))

    @property
    def floor(self) -> float:
        """Residuals below this floor are rounding or the error of the finest steps, in units of q over the balance."""
        return max(self.rounding, self.of_steps.get(self.variant.order, 0.0))

    @property
    def about_the_noise(self) -> float:
        """Largest misfit that counts as noise, in units of q over the balance."""
        return math.hypot(AT_THE_NOISE * self.precision, self.floor)

    def explain(self, trial: Trial, by_steps: float) -> None:
        """Raise the floor of misfits to the error `by_steps` of the finest steps, if this error explains the misfit.

        The misfit has to be at most `EXACT_ENOUGH` of the spread: a larger one may be that of a wrong model.
        """
        least = math.hypot(by_steps, self.about_the_noise)
        if self.about_the_noise < trial.rms <= min(least, EXACT_ENOUGH * self.spread):
            self.of_steps[self.variant.order] = least

    @property
    def exact(self) -> bool:
        """True if the data have no noise beyond what counts as rounding."""
        return self.precision < self.floor

    def _weights(self, numbers: Sequence[str]) -> tuple[dict[str, float], dict[str, float]]:
        """Prior weights 1/variance by number: all, and those of waves and of powers that waves can imitate."""
        # A search keeps the prior of rates narrow: under a controller other rates would imitate wrong forces of inputs.
        prior, bands = prior_of(self.model, self.base, None, wide_rates=False), self.variant.functions
        names = [numbers[int(i)] for i in prior.index]
        weights = {name: spread**-2 for name, spread in zip(names, prior.spread.tolist(), strict=True)}
        powers = [self.keys[name] for name in self.always if bands and not name.startswith(ALWAYS)]
        spreads = prior_spreads(bands, self.base, self.data.balance, powers)
        centred = {self.place[key]: spread**-2 for key, spread in spreads.items()}
        return weights | centred, centred

    def prior(self, names: Collection[str], scales: Mapping[str, float] | None = None) -> Gaussian:
        """Prior of these numbers, in the order of the model; `scales` multiply the variances of functions."""
        names, weights = set(names), dict(self.weights)
        for name, scale in (scales or {}).items():
            weights |= {wave: weights[wave] / scale for wave in self.functions[name]}
        own, q = [name for name in self.start if name in names], self.data.q
        mean, weight = [self.start[name] for name in own], [weights.get(name, 0.0) for name in own]
        return Gaussian(q.new_tensor(mean), q.new_tensor(weight))

    def waves(self, prior: Gaussian, numbers: Sequence[str]) -> Tensor:
        """Weights of a prior of these numbers, (P,): those of waves of functions, 0 for other numbers."""
        waves = {name for own in self.functions.values() for name in own}
        return torch.where(torch.tensor([name in waves for name in numbers], dtype=torch.bool), prior.weight, 0.0)

    def problem(self, length: int) -> ShootingProblem:
        """The shooting problem over all numbers with segments of this length, made once."""
        if length not in self.problems:
            grid, u = self.grids.of(length, self.base.model_step)
            own = {"sigma": min(max(self.precision, self.floor), self.spread), "freedom": self.freedom}
            self.problems[length] = ShootingProblem(self.model, self.data, grid, u=u, **own)
        return self.problems[length]

    def numbers(self, taken: Iterable[str]) -> list[str]:
        """Names of the numbers of a model with these offers."""
        taken, offers = set(taken), (*self.offers, *self.loads)
        return [*self.always, *(name for offer in offers if offer.name in taken for name in offer.numbers)]

    def values_of(self, trial: Trial) -> dict[str, float]:
        """The values of a trial of another fitter, by the names of the same numbers here."""
        value = {trial.fitter.keys[name]: x for name, x in trial.values.items()}
        return {name: value[key] for name, key in self.keys.items() if key in value}

    def fit(
        self, taken: Iterable[str], values: dict[str, float], length: int, before: Trial | None, most: int = ITERATIONS,
        states: Tensor | None = None,
    ) -> Trial | None:  # fmt: skip
        """A trial with the offers `taken` over segments of this length; None if no path is found.

        The fit begins with `values`, and with `states` (S, d) or, if None, those of the trial `before` or, without
        one, of smoothed samples. `before` also gives σ and the prior variances of functions.
        """
        taken, every = frozenset(taken), self.problem(length)
        names = self.numbers(taken)
        sigma = every.sigma if before is None else max(before.rms, self.floor)
        scales = {} if before is None else before.likeliest_scales
        problem = every.of(names, sigma, self.prior(names, scales))
        names = problem.parameters.numbers
        theta = self.data.q.new_tensor([values.get(name, self.start[name]) for name in names])
        if before is None:
            states = first_states(problem, theta, self.smooth)
        elif states is None:
            states = before.problem.states_at(before.path, problem.grid.start_sample, problem.d)
        if problem.compiled is None:
            if before is None:
                problem.guess_from_states(states_of_pairs(self.model, self.smooth))
            else:
                problem.guess_from(before.problem, before.path)
        x, damping = problem.pack(theta, states), NEAR if before is not None and before.length == length else FAR_OFF
        x, path = _minimised(problem, x, most, damping)
        if path is None:
            return None
        found = dict(zip(names, problem.unpack(x)[0].tolist(), strict=True))
        return Trial(self, taken, self.start | found, problem, path, scales)

    def free_run_score(self, trial: Trial) -> Score | None:
        """The score of a free run over the last quarter of every trajectory, after a fit to the rest; None: no path."""
        names = trial.problem.parameters.numbers
        problem = self.problem(trial.length).of(names, max(trial.rms, self.floor), trial.prior)
        part = torch.cat([torch.arange(length) < round(FITTED_SHARE * length) for length in self.data.lengths])
        problem.used, problem.path = part.to(self.data.t.device), trial.path
        problem._weigh()
        x = problem.unknowns(trial.theta, trial.path)
        _, path = _minimised(problem, x, 2 * ITERATIONS, NEAR)
        return None if path is None else free_run_score(problem, path, trial.score.numbers, self.floor)

    def longer(self, trial: Trial) -> Trial | None:
        """The model over segments of the next length; None if no length is left, or the model does not follow these.

        None also if the model is `unstable`: held-out blocks of longer segments would compare starts, and no forces. If
        the misfit exceeds the noise, the segments grow all the same: a wrong model may be unstable where the motion is
        stable.
        """
        if trial.whole or trial.unstable:
            return None
        length = self.lengths[self.lengths.index(trial.length) + 1]
        found = self.fit(trial.taken, trial.values, length, trial)
        return None if found is None or found.rms > trial.followed else found

    def over(self, trial: Trial, length: int) -> Trial | None:
        """The model over shorter segments, of this length; None if no path is found."""
        return self.fit(trial.taken, trial.values, length, None, 2 * ITERATIONS)

    def grow(self, trial: Trial) -> Trial:
        """The model over the longest segments that it follows, lengthened step by step."""
        while (found := self.longer(trial)) is not None:
            trial = found
        return trial

    def leap(self, trial: Trial) -> Trial:
        """The model over whole trajectories at once or, if it does not follow these closely, as `grow`."""
        whole = self.fit(trial.taken, trial.values, self.lengths[-1], trial)
        return whole if whole is not None and whole.near else self.grow(trial)


def _terms(
    data: Trajectories, config: FitConfig, variant: Variant, ratios: Mapping[tuple[int, int], str] | None
) -> NamedTerms:
    """The named terms of a variant: those of the settings or the candidates, windings, and what its functions need."""
    terms = NamedTerms(config.features) if config.features else candidates(data, config.translations, ratios)
    if variant.windings:
        terms = terms.joined(NamedTerms(tuple(windings(data.angles))))
    if variant.functions:
        terms = terms_with(variant.functions, terms, data.angles, variant.kept)
    return replace(terms, dissipation=variant.dissipation)


def _undetermined_masses(data: Trajectories, config: FitConfig) -> set[str]:
    """Names of the masses whose scale positions do not determine: of coordinates that no term joins to the first one.

    If such a mass were free, a larger mass would, to first order, make up for every force that leaves the model.
    """
    apart = groups(config.features, data.angles)[1:] if config.features else []
    return {f"kinetic.log_diagonal[{own[0] - 1}]" for own in apart}


def _minimised(problem: ShootingProblem, x: Tensor, most: int, damping: float) -> tuple[Tensor, Path | None]:
    """The unknowns after a fit from x in at most `most` iterations, and their path; None if no path is found."""
    result = levenberg_marquardt(problem, x, max_iterations=most, rtol=1e-3, patience=2, damping=damping)
    return result.x, problem.solve(result.x) if math.isfinite(result.cost) else None


def is_precise(data: Trajectories) -> bool:
    """True if a rule of order 4 is worth its time: few samples a period, or little noise."""
    return coarse(data) or precision(data) < ORDER_4_NOISE * relative_spread(data)


def masses(data: Trajectories) -> tuple[float, ...]:
    """Start of log √m_i for all masses but the first, which is 1: √m_i q̇_i has the same spread for all coordinates.

    Positions would not do, because a coordinate that drifts goes far without a force. Velocities count as at least the
    spread of the positions over the duration, so that no mass is infinite.
    """
    least = data.balance.double() / max(float(one.t[-1] - one.t[0]) for one in data)
    spread = slopes(data, data.q.double()).std(0).maximum(least)
    return tuple((spread[0] / spread[1:]).log().tolist())


def moved(trial: Trial, problem: ShootingProblem, theta: Tensor) -> float:
    """RMS change of the motion of a trial, in units of q over the balance, by the step rule of another problem."""
    if problem.compiled is None:
        problem.guess_from(trial.problem, trial.path)
    path = problem.solve(problem.unknowns(theta, trial.path))
    if path is None:
        return math.inf
    return float((problem.misfit(path) - trial.problem.misfit(trial.path)).square().mean().sqrt())


def explained_by_steps(change: float, order: int) -> float:
    """Largest misfit that the error of steps explains, from the change of the motion by halved ones (Richardson)."""
    return AT_THE_NOISE * change * 2**order / (2**order - 1)


def scores_of(own: Trial, other: Trial) -> tuple[Score, Score]:
    """The scores of two models with a common floor, because losses of different floors cannot be compared."""
    floor = max(own.fitter.floor, other.fitter.floor)
    return own.score_above(floor), other.score_above(floor)


def of_one_length(own: Trial, other: Trial) -> tuple[Trial, Trial] | None:
    """Two models over segments of one length; None if their segments differ, and the longer segments decide.

    Segments are as long as they can be if noise grows to the spread of the motion in longer segments
    (`Trial.unstable`). If the model of the shorter segments is so, and the model of the longer segments misses these by
    more than the noise, the longer segments say nothing: both models are compared over the shorter segments.
    """
    if own.length == other.length:
        return own, other
    long, short = (own, other) if own.length > other.length else (other, own)
    if long.segments_at_the_noise or not short.unstable or (same := long.over(short.length)) is None:
        return None
    return (same, short) if long is own else (short, same)


def likeliest(trial: Trial, most: int) -> Trial:
    """The model refitted with the likeliest prior variances of its bands (`Trial.likeliest_scales`).

    Each refit has at most `most` iterations. Refits end when the held-out log-loss falls by less than the price of one
    parameter. A refit with a larger log-loss is dropped. A model without functions is returned as it is.
    """
    gain = math.inf
    while trial.likeliest_scales and gain > trial.score.price_of_a_number:
        other = trial.fitter.fit(trial.taken, trial.values, trial.length, trial, most)
        if other is None or not (gain := float((trial.score.losses - other.score.losses).sum())) > 0:
            break
        trial = other
    return trial


def compared_models(fitters: Iterable[Fitter], trial: Trial) -> list[dict[str, Any]]:
    """The models that were scored over segments of the length of a trial, and the trial itself, by their size.

    None where held-out blocks do not tell the error of the trial.
    """
    if not math.isfinite(trial.score.rms):
        return []
    rows: dict[frozenset[str], Compared] = {}
    for fitter in fitters:
        for row in fitter.compared:
            best = rows.get(row.taken)
            better = math.isfinite(row.held_out) and (best is None or row.held_out < best.held_out)
            if row.length == trial.length and better:
                rows[row.taken] = row
    rows[trial.taken] = Compared(trial.length, trial.problem.P, trial.score.rms, trial.taken)
    order = [offer.name for offer in (*trial.fitter.offers, *trial.fitter.loads)]
    return [
        {
            "numbers": row.numbers,
            "held_out": row.held_out,
            "offers": [name for name in order if name in row.taken],
            "taken": row.taken == trial.taken,
        }
        for row in sorted(rows.values(), key=lambda row: (row.numbers, row.held_out))
    ]
