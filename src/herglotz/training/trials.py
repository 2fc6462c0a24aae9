"""A model of a search with its fit, and the fits of subsets of a dictionary's numbers.

A model is a set of offers (`offers`), fitted by multiple shooting over segments that grow while it follows the data.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.input_terms import input_terms_of
from herglotz.data.roughness import AT_THE_NOISE, coarse, precision, relative_spread
from herglotz.data.smoothing import smoothed
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.dictionary import keys_of
from herglotz.training.first_states import first_states, states_of_pairs
from herglotz.training.functions import Band, prior_spreads, terms_with
from herglotz.training.held_out import HeldOut
from herglotz.training.named_terms import DRY, candidates, settings_of, started, turns_one_way
from herglotz.training.offers import ALWAYS, offers_of, without_offers
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import Grids, segment_lengths
from herglotz.training.problems.prior import Gaussian, prior_of
from herglotz.training.problems.robust import scale_of
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.score import Score, fitted_score, free_run_score, scores
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt
from herglotz.training.solvers.lifted_newton import Path
from herglotz.training.task import EXACT, build_model, with_sticking
from herglotz.training.trajectory_fit import FAR_OFF, FOLLOWED, LOST, NEAR

ITERATIONS = 15  # of a fit: a trial that needs more starts too far off
SEEN = 0.75  # of every trajectory: finalists are fitted to it, and run free over the rest
SHORT = (5, 10)  # recorded steps of the first segments: over these motion is all but linear in the forces
ASTRAY = 0.25  # of the spread: segments that are missed by more are not followed, whatever shorter ones miss
FINER = 0.3  # of the misfit: a rule that changes the motion by more is worth trying
ALIKE = 10.0  # times the σ of exact data: misfits below it are all as good
SMOOTH = 1e-3  # of the spread: data that are more precise are worth a rule of order 4


@dataclass(frozen=True)
class Variant:
    """What a model is beside its numbers."""

    order: int
    substeps: int = 1
    sticking: bool = False
    functions: tuple[Band, ...] = ()  # of the coordinates, beside named terms
    dissipation: tuple[str, ...] = ()  # powers of s in L
    kept: frozenset[str] = frozenset()  # offers that stay where functions could stand for them

    def crossing(self, times: float) -> Variant:
        """The same with about as long model steps, where recorded steps are so many times as long."""
        return replace(self, substeps=max(1, round(times * self.substeps)))


class Compared(NamedTuple):
    """A model that was scored."""

    length: int  # recorded steps of its segments
    numbers: int
    held_out: float  # RMS error over held-out blocks, in units of q over the balance
    taken: frozenset[str]


@dataclass(frozen=True)
class Trial:
    """A model with its fit."""

    fitter: Fitter
    taken: frozenset[str]
    values: dict[str, float]  # of all numbers
    problem: ShootingProblem
    path: Path
    scales: Mapping[str, float] = field(default_factory=dict)  # variances of its functions, over those of `Fitter`

    @property
    def theta(self) -> Tensor:
        """(P,) of the free numbers."""
        return self.path.x.new_tensor([self.values[name] for name in self.problem.parameters.numbers])

    @cached_property
    def rms(self) -> float:
        """Misfit of the data, in units of q over the balance."""
        r = self.problem.misfit(self.path)[self.problem.data.complete]
        return scale_of(r) if self.problem.freedom else float(r.square().mean().sqrt())

    @property
    def names(self) -> list[str]:
        """What it has taken, in the order of the dictionary."""
        return [offer.name for offer in (*self.fitter.offers, *self.fitter.loads) if offer.name in self.taken]

    @property
    def pushing(self) -> dict[str, int]:
        """Dry friction that would create energy, with its coordinate."""
        several = self.fitter.data.dof > 1
        every = {DRY + (f"[{i}]" if several else ""): i for i in range(self.fitter.data.dof)}
        return {name: i for name, i in every.items() if name in self.taken and self.values[name] <= 0}

    @property
    def length(self) -> int:
        """Recorded steps of its segments."""
        return self.problem.grid.length

    @property
    def whole(self) -> bool:
        """Whether it follows whole trajectories."""
        return not self.problem.jointed

    @property
    def near(self) -> bool:
        """Whether it follows whole trajectories so closely that its linear motion says which offers are worth a fit."""
        return self.whole and self.rms <= FOLLOWED * self.fitter.spread

    @property
    def at_the_noise(self) -> bool:
        """Whether it follows whole trajectories as precisely as they are known."""
        return self.whole and self.rms <= max(AT_THE_NOISE * self.fitter.precision, self.fitter.floor)

    @cached_property
    def _own(self) -> HeldOut:
        """Held-out blocks of this model."""
        waves = self.fitter.waves(self.prior, self.problem.parameters.numbers)
        return HeldOut(self.problem, self.path, self.theta, waves=waves)

    @cached_property
    def _told(self) -> Tensor:
        """How much of each number the data tell, (P,)."""
        return self._own.told([range(self.problem.P)])[0]

    @cached_property
    def score(self) -> Score:
        """Its loss over held-out blocks."""
        count, choices = int((self.problem.weight > 0).sum()), [len(self.taken)]
        (found,) = scores(self._own, [range(self.problem.P)], choices, count, self.fitter.floor)
        self.fitter.compared.append(Compared(self.length, self.problem.P, found.rms, self.taken))
        return found

    def replaces(self, simple: Trial) -> bool:
        """Whether this richer model replaces a simpler one."""
        return self.gain(simple) > 0

    def gain(self, simple: Trial, more: int = 0) -> float:
        """By how much it does, with so many numbers beside its own; infinite where it follows longer segments."""
        if self.length != simple.length:
            return math.inf if self.length > simple.length else -math.inf
        offered = max(self.fitter.offered, simple.fitter.offered)
        return replace(self.score, zeros=more).gain(simple.score, offered)

    def fits_better(self, simple: Trial, zeros: int = 0) -> bool:
        """Whether it replaces a model that has the same offers, with so many zeros of sensors beside its numbers."""
        if self.length != simple.length:
            return self.length > simple.length
        its = fitted_score(simple.problem, simple.path, self.fitter.floor)
        own = fitted_score(self.problem, self.path, self.fitter.floor, zeros)
        return own.replaces(its, self.fitter.offered)

    @property
    def prior(self) -> Gaussian:
        """Of its numbers."""
        assert isinstance(self.problem.prior, Gaussian)
        return self.problem.prior

    @cached_property
    def sizes(self) -> dict[str, float]:
        """The variance of each function, over that of its prior, at which this fit is likeliest (MacKay 1992)."""
        numbers, found = self.problem.parameters.numbers, {}
        place = {name: i for i, name in enumerate(numbers)}
        weight = self.fitter.prior(numbers).weight
        for name, waves in self.fitter.functions.items():
            if at := [place[wave] for wave in waves if wave in place]:
                told = float(self._told[at].sum())
                found[name] = float((self.theta[at].square() * weight[at]).sum()) / max(told, 1.0)
        return {name: size for name, size in found.items() if size > 0}


class Fitter:
    """Fits of subsets of a dictionary's numbers to recordings, by one variant of its model."""

    def __init__(
        self, data: Trajectories, base: Baseline, config: FitConfig, variant: Variant, freedom: float | None,
        like: Fitter | None = None,
    ):  # fmt: skip
        self.data, self.variant, self.freedom = data, variant, freedom
        every_band, terms = variant.functions, candidates(data, config.translations)
        terms = terms_with(every_band, terms, data.angles, variant.kept) if every_band else terms
        self.terms = terms = replace(terms, dissipation=variant.dissipation)
        settings = replace(settings_of(terms, data, config, variant.order, variant.substeps), sticking=variant.sticking)
        first = {"damping.rate": (base.rate,), "kinetic.base.log_diagonal": masses(data)}
        base = started(base, data, first, settings)
        self.base, self.settings = base, settings
        model = build_model(base, settings, "none")
        self.model = with_sticking(model, excess=False) if variant.sticking else model
        every = ParameterVector(self.model)
        self.keys = dict(zip(every.numbers, keys_of(every.numbers, self.model.config), strict=True))
        self.always, every_offer, self.simple = offers_of(
            self.model, list(self.keys.values()), every_band, len(input_terms_of(data.columns))
        )
        without_offers(self.model, every_offer)
        one_way = [f"load {i + 1}" for i in range(data.dof) if turns_one_way(data, i)]  # is dry friction already
        self.offers = [offer for offer in every_offer if offer.name not in one_way]
        self.loads = [offer for offer in every_offer if offer.name in one_way]
        self.start = dict(zip(every.numbers, every.get().tolist(), strict=True))
        own, self.weights = prior_of(self.model, base, None), {}
        place = {key: name for name, key in self.keys.items()}
        self.functions = {own.name: [place[text] for text in own.texts] for own in every_band}  # numbers of waves
        for i, spread in zip(own.index.tolist(), own.spread.tolist(), strict=True):
            self.weights[every.numbers[i]] = spread**-2
        powers = [self.keys[name] for name in self.always if every_band and not name.startswith(ALWAYS)]
        spreads = prior_spreads(every_band, base, data.balance, powers)
        self.centred = {place[key]: spread**-2 for key, spread in spreads.items()}
        self.weights |= self.centred
        lengths = segment_lengths(data)
        self.lengths = [*(length for length in SHORT if length < lengths[0]), *lengths]
        self.problems: dict[int, ShootingProblem] = {}
        self.grids = Grids(data) if like is None else like.grids  # the same for all variants
        self.floor = ALIKE * EXACT["float64"] * max(base.scale)
        self.offered = len(every_offer)
        known = (smoothed(data), precision(data), relative_spread(data)) if like is None else like.known
        self.known = self.smooth, self.precision, self.spread = known  # of the data, whatever the variant
        self.compared: list[Compared] = []

    def prior(self, names: Collection[str], scales: Mapping[str, float] | None = None) -> Gaussian:
        """Of these numbers, in the order of the model; with `scales` of the variances of functions."""
        names, weights = set(names), dict(self.weights)
        for name, scale in (scales or {}).items():
            weights |= {wave: weights[wave] / scale for wave in self.functions[name]}
        own = [name for name in self.start if name in names]
        like = self.data.q
        return Gaussian(
            like.new_tensor([self.start[name] for name in own]),
            like.new_tensor([weights.get(name, 0.0) for name in own]),
        )

    def waves(self, prior: Gaussian, numbers: Sequence[str]) -> Tensor:
        """The weights of a prior of these numbers that are waves of functions, 0 of the others, (P,)."""
        waves = {name for own in self.functions.values() for name in own}
        return torch.where(torch.tensor([name in waves for name in numbers], dtype=torch.bool), prior.weight, 0.0)

    def problem(self, length: int) -> ShootingProblem:
        """Of all numbers."""
        if length not in self.problems:
            grid, u = self.grids.of(length, self.base.model_step)
            own = {"sigma": min(max(self.precision, self.floor), self.spread), "freedom": self.freedom}
            self.problems[length] = ShootingProblem(self.model, self.data, grid, u=u, **own)
        return self.problems[length]

    def numbers(self, taken: Iterable[str]) -> list[str]:
        """Of a model with these offers."""
        taken = set(taken)
        every = (*self.offers, *self.loads)
        return [*self.always, *(name for offer in every if offer.name in taken for name in offer.numbers)]

    def values_of(self, trial: Trial) -> dict[str, float]:
        """The values of a trial by the names that its numbers have here, where other terms stand beside them."""
        value = {trial.fitter.keys[name]: x for name, x in trial.values.items()}
        return {name: value[key] for name, key in self.keys.items() if key in value}

    def fit(
        self, taken: Iterable[str], values: dict[str, float], length: int, before: Trial | None, most: int = ITERATIONS,
        states: Tensor | None = None,
    ) -> Trial | None:  # fmt: skip
        """From these values and states, or those of a fit before or of smoothed samples; None: no path is found."""
        taken, every = frozenset(taken), self.problem(length)
        names = self.numbers(taken)
        sigma = every.sigma if before is None else max(before.rms, self.floor)
        scales = {} if before is None else before.sizes
        problem = every.of(names, sigma, self.prior(names, scales))
        names = problem.parameters.numbers
        theta = self.data.q.new_tensor([values.get(name, self.start[name]) for name in names])
        if before is None:
            states = first_states(problem, theta, self.smooth)
            if problem.compiled is None:
                problem.guess_from_states(states_of_pairs(self.model, self.smooth))
        else:
            if states is None:
                states = before.problem.states_at(before.path, problem.grid.start_sample, problem.d)
            if problem.compiled is None:
                problem.guess_from(before.problem, before.path)
        x = problem.pack(theta, states)
        near = before is not None and before.length == length
        damping = NEAR if near else FAR_OFF
        result = levenberg_marquardt(problem, x, max_iterations=most, rtol=1e-3, patience=2, damping=damping)
        path = problem.solve(result.x) if math.isfinite(result.cost) else None
        if path is None:
            return None
        found = dict(zip(names, problem.unpack(result.x)[0].tolist(), strict=True))
        return Trial(self, taken, self.start | found, problem, path, scales)

    def foretold(self, trial: Trial) -> Score | None:
        """The score of a free run over the last quarter of every trajectory, which is not fitted; None: no path."""
        names = trial.problem.parameters.numbers
        problem = self.problem(trial.length).of(names, max(trial.rms, self.floor), trial.prior)
        part = torch.cat([torch.arange(length) < round(SEEN * length) for length in self.data.lengths])
        problem.used, problem.path = part.to(self.data.t.device), trial.path
        problem._weigh()
        x = problem.pack(trial.theta, trial.path.x[:, 0, : problem.d])
        result = levenberg_marquardt(problem, x, max_iterations=2 * ITERATIONS, rtol=1e-3, patience=2, damping=NEAR)
        path = problem.solve(result.x) if math.isfinite(result.cost) else None
        return None if path is None else free_run_score(problem, path, trial.score.numbers, self.floor)

    def longer(self, trial: Trial) -> Trial | None:
        """Over segments of the next length; None where there is none, or the model does not follow the data so long."""
        if trial.whole:
            return None
        length = self.lengths[self.lengths.index(trial.length) + 1]
        found = self.fit(trial.taken, trial.values, length, trial)
        followed = min(max(LOST * trial.rms, FOLLOWED * self.spread), ASTRAY * self.spread)
        return None if found is None or found.rms > followed else found

    def grow(self, trial: Trial) -> Trial:
        """Over segments that grow as long as the model follows the data."""
        while (found := self.longer(trial)) is not None:
            trial = found
        return trial

    def leap(self, trial: Trial) -> Trial:
        """Over whole trajectories at once where a model that is known follows these, or as `grow`."""
        whole = self.fit(trial.taken, trial.values, self.lengths[-1], trial)
        return self.grow(trial) if whole is None or whole.rms > FOLLOWED * self.spread else whole


def is_precise(data: Trajectories) -> bool:
    """Whether the data are worth a rule of order 4."""
    return coarse(data) or precision(data) < SMOOTH * relative_spread(data)


def masses(data: Trajectories) -> tuple[float, ...]:
    """Logarithms of the roots of masses but the first, 1, that make all coordinates alike, each over its balance."""
    balance = data.balance.double()
    return tuple((balance[0] / balance[1:]).log().tolist())


def moved(trial: Trial, problem: ShootingProblem, theta: Tensor) -> float:
    """By how much the rule of another problem changes the motion of a trial, RMS."""
    if problem.compiled is None:
        problem.guess_from(trial.problem, trial.path)
    path = problem.solve(problem.pack(theta, trial.path.x[:, 0, : problem.d]))
    if path is None:
        return math.inf
    return float((problem.misfit(path) - trial.problem.misfit(trial.path)).square().mean().sqrt())
