"""One search over offers, from both ends: up from the simplest model, and down from the whole dictionary.

A model is a set of offers (`offers`), fitted by multiple shooting over segments that grow while it follows the data.
Its linear motion says which offers are worth a fit (`moves`); the fit is compared by the one inequality of `score`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from functools import cached_property

from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.input_terms import with_input_terms
from herglotz.data.roughness import part_of
from herglotz.data.sensors import measured
from herglotz.data.smoothing import local_polynomials
from herglotz.models.drag import input_forces
from herglotz.models.features import spherical
from herglotz.progress import FEWER_TERMS, FIRST_TERMS, MORE_TERMS, inside, part
from herglotz.training.acting_inputs import asked_terms, columns_of
from herglotz.training.baseline import Baseline, estimate_baseline
from herglotz.training.config import FitConfig
from herglotz.training.linear_terms import start_of
from herglotz.training.moves import Moves
from herglotz.training.named_terms import DRY, NamedTerms, candidates, special, started
from herglotz.training.offers import standing
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import FIRST_SEGMENT
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.sensor_zeros import clear, differing_zeros
from herglotz.training.strengths import likeliest, needed
from herglotz.training.task import LEAST_GRIP, build_model
from herglotz.training.trials import ALIKE, ASTRAY, FINER, ITERATIONS, Fitter, Trial, Variant, is_precise, moved

PART = 2000  # samples that a search is made of, where there are more than twice as many
FEW = 5  # iterations of a trial's fit, in the place of `ITERATIONS`, on more samples than a search is made of
TRIED = 3  # changes of a kind whose fits are compared, of those that the linear motion puts first
EXCESS = "friction.breakaway"  # of breakaway, Stribeck's
FINEST, STEPS = 16, 40_000  # model steps in a recorded one, and in all trajectories

# A search, its model, and the zeros (B, n) that have been taken off its readings, with their deviations.
Zeroed = tuple["Search", Trial | None, tuple[Tensor, Tensor] | None]


class Search:
    """See the head of this module. A step of its data is `longer` times one of the data that are to be fitted."""

    def __init__(self, data: Trajectories, base: Baseline, config: FitConfig, outliers: bool = False):
        # Functions are made for what `over` holds: of a part of long recordings all of them.
        self.data, self.base, self.config, self.over = data, base, config, data
        self.freedom = FREEDOM if outliers else None
        self.order = 4 if is_precise(data) and data.dof == 1 else 2
        self.fitters: dict[Variant, Fitter] = {}
        self.finest = max(1, min(FINEST, STEPS // data.samples))
        self.tried, self.most, self.part, self.longer = TRIED, ITERATIONS, self, 1.0
        if (few := part_of(data, PART)) is not data:
            self.part, self.tried, self.most, m = self.of(few), 1, FEW, few.typical_step / data.typical_step
            self.part.longer, self.part.base = m, base.stepped(m)

    def of(self, data: Trajectories) -> Search:
        """The same of other data."""
        other = Search(data, self.base, self.config, outliers=self.freedom is not None)
        other.order, other.over = self.order, self.over
        return other

    def fitter(self, variant: Variant) -> Fitter:
        """Of one variant."""
        if variant not in self.fitters:
            like = next(iter(self.fitters.values()), None)
            self.fitters[variant] = Fitter(self.data, self.base, self.config, variant, self.freedom, like)
        return self.fitters[variant]

    @cached_property
    def first(self) -> Trial | None:
        """What the simplest model grows into, the better one of where offers join on the way and where none do.

        Where inputs follow from the state, terms that join over short segments make up for one another.
        """
        part(FIRST_TERMS)
        fitter = self.fitter(Variant(self.order))
        best, plain = self.climbed(fitter, fitter.simple, {}), self.grown(fitter, fitter.simple)
        if plain is not None and (best is None or plain.length >= best.length):
            best = self.better(best, self.settled(plain))
        return best

    @cached_property
    def full(self) -> Trial | None:
        """The model of the whole dictionary over the longest segments that it follows."""
        fitter = self.fitter(Variant(self.order))
        return self.grown(fitter, [offer.name for offer in fitter.offers])

    @inside()
    def run(self) -> Trial | None:
        """The model that held-out time asks for; None where not even the shortest segments can be followed."""
        best = self.first
        part(MORE_TERMS)
        ends = [best]
        fitter = self.fitter(Variant(self.order))
        ends.append((start := self.linear_start(fitter)) and self.climbed(fitter, *start))
        if not (best and best.at_the_noise) and (full := self.full) and (best is None or full.length >= best.length):
            ends.append(self.settled(full, swapped=True))
        for end in ends[1:]:
            best = self.better(best, end)
        if best is None:
            return None
        part(FEWER_TERMS)
        every = [offer.name for offer in best.fitter.offers]
        down = best.fitter.fit(every, best.values, best.length, best, 2 * ITERATIONS)
        ends.append(down and self.settled(self.finer(best.fitter.grow(down)), swapped=True))
        best = self.better(best, ends[-1])
        if best is not None and best is not ends[-1]:
            ends.append(best := self.settled(best, swapped=True))
        return self.stuck(best and self.braking(self.finalist(best, ends)))

    def of_part(self, found: Trial | None, differ: bool) -> Zeroed:
        """A model that was found in `part`, fitted to all data, with what more these ask for.

        `differ`: recordings of the part were found to have zeros of sensors of their own.
        """
        read, best, zeros = self.with_zeros(found and self.again(found), sure=differ)
        return read, best and read.settled(best), zeros

    def again(self, found: Trial) -> Trial | None:
        """The model of a trial fitted to these data, from its values; None where it does not follow them."""
        if found.fitter.data is self.data:
            return found
        fitter = self.fitter(found.fitter.variant.crossing(self.data.typical_step / found.fitter.data.typical_step))
        if found.fitter.data.lengths == self.data.lengths:
            return fitter.fit(found.taken, found.values, found.length, found, 2 * ITERATIONS)
        if (whole := fitter.fit(found.taken, found.values, fitter.lengths[-1], None, 2 * ITERATIONS)) and whole.near:
            return self.finer(whole)
        first = next((length for length in fitter.lengths if length >= FIRST_SEGMENT), fitter.lengths[-1])
        other = fitter.fit(found.taken, found.values, first, None)
        return other and self.finer(fitter.leap(other))

    def finalist(self, best: Trial, ends: Sequence[Trial | None]) -> Trial:
        """Of the ends of the search and the simplest model the one that free runs over held-out time ask for.

        Blocks in between are foretold from both sides; where a force is missing, as residuals above the noise show,
        terms that make up for it there may not carry on.
        """
        if best.at_the_noise or not best.whole:
            return best
        fitter = best.fitter
        simple = fitter.fit(fitter.simple, best.values, best.length, best, 2 * ITERATIONS)
        every = (end for end in (simple, *ends) if end is not None and end.length == best.length)
        others = {(end.fitter.variant, end.taken): end for end in every}
        scored = [(end, end.fitter.foretold(end)) for end in others.values()]
        scored = sorted(((end, x) for end, x in scored if x is not None), key=lambda pair: pair[1].numbers)
        winner, least, offered = best, None, max(end.fitter.offered for end in others.values())
        for end, found in scored:
            if least is None or found.replaces(least, offered):
                winner, least = end, found
        return winner

    def linear_start(self, fitter: Fitter) -> tuple[list[str], dict[str, float]] | None:
        """Offers and values that one linear problem of smoothed accelerations gives; None where it gives none.

        Its terms are those that do not stand for one another in noise.
        """
        local, every = local_polynomials(self.data), candidates(self.data, self.config.translations)
        every = every.only(set(every.names).difference(special(self.data), spherical(self.data.angles)))
        every = every.joined(NamedTerms(drag=self.config.drag))
        start = None if local is None else start_of(self.data, self.base, every, local)
        if start is None:
            return None
        base = started(self.base, self.data, start.values, fitter.settings)
        numbers = ParameterVector(build_model(base, fitter.settings, "none"))
        values = dict(zip(numbers.numbers, numbers.get().tolist(), strict=True))
        return [offer.name for offer in fitter.offers if values[offer.amplitudes[0]] != 0], values

    def climbed(self, fitter: Fitter, taken: Iterable[str], values: dict[str, float], joining=True) -> Trial | None:
        """From the shortest segments on, offers joining at every length, over which motion is ever less linear."""
        trial = fitter.fit(taken, values, fitter.lengths[0], None, 2 * ITERATIONS)
        while trial is not None:
            trial = self.finer(trial)
            while joining and not trial.whole and (more := self.moved(trial)) is not None:
                trial = self.finer(more)
            if (longer := trial.fitter.longer(trial)) is None:
                return self.settled(needed(likeliest(trial, 2 * self.most), 2 * self.most))
            trial = longer
        return None

    def grown(self, fitter: Fitter, taken: Iterable[str]) -> Trial | None:
        """A model as it is over the longest segments that it follows."""
        trial = fitter.fit(taken, {}, fitter.lengths[0], None, 2 * ITERATIONS)
        return trial and self.finer(fitter.grow(self.finer(trial)))

    def better(self, up: Trial | None, down: Trial | None) -> Trial | None:
        """The better one of two models."""
        if up is None or down is None:
            return up or down
        rich, simple = (up, down) if up.problem.P > down.problem.P else (down, up)
        return rich if rich.replaces(simple) else simple

    def settled(self, trial: Trial, *, swapped: bool = False) -> Trial:
        """With offers that join and leave, and take the place of others, until none does."""
        seen = {trial.taken}
        while (other := self.moved(trial, seen, whole=True, swapped=swapped)) is not None:
            seen.add(other.taken)
            trial = self.finer(other.fitter.grow(likeliest(other, 2 * self.most)))
        return trial

    def moved(
        self, trial: Trial, seen: Collection[frozenset[str]] = (), *, whole: bool = False, swapped: bool = False
    ) -> Trial | None:
        """With the offers that its linear motion asks for; None where no fit of these is better.

        One offer joins, but no dry friction that pushes; in `whole` models many leave, and one is `swapped`.
        """
        moves, at = Moves(trial), trial.taken
        kinds = [moves.joining, *([moves.leaving] if whole else []), *([moves.exchanges] if swapped else [])]
        for taken in (taken for kind in kinds for taken in kind(at)[: self.tried]):
            if taken in seen:
                continue
            values, states = moves.start(taken)
            other = trial.fitter.fit(taken, values, trial.length, trial, 2 * self.most, states)
            astray = other is not None and other.rms > max(trial.rms, ASTRAY * trial.fitter.spread)
            if other is None or astray or not set(other.pushing) <= set(trial.pushing):
                continue
            if self.better(trial, other) is other:
                return other
        return None

    def finer(self, trial: Trial) -> Trial:
        """With halved steps while that changes the motion by a good part of the misfit."""
        while trial.fitter.variant.substeps < self.finest:
            fitter = trial.fitter
            other = self.fitter(replace(fitter.variant, substeps=2 * fitter.variant.substeps))
            problem = other.problem(trial.length).of(other.numbers(trial.taken), trial.problem.sigma)
            if moved(trial, problem, trial.theta) <= FINER * max(trial.rms, fitter.floor / ALIKE):
                break
            fit = other.fit(trial.taken, trial.values, trial.length, trial)
            if fit is None or trial.replaces(fit):
                break
            trial = other.grow(fit)
        return trial

    def better_on_a_line(self, trial: Trial | None) -> bool:
        """Whether angles that are taken for positions on a line, as of a free spring, give a better model."""
        if not any(self.data.angles) or self.config.translations or (trial is not None and trial.at_the_noise):
            return False
        data = replace(self.data, angles=(False,) * self.data.dof)
        base = estimate_baseline(data, outliers=self.freedom is not None)
        line = Search(data, base, replace(self.config, drag=()), outliers=self.freedom is not None)
        if trial is not None and trial.whole and (line.first is None or trial.replaces(line.first)):
            return False  # the motion is followed as it is, and no worse model is worth a search
        other = line.run()
        if other is None or trial is None or not other.replaces(trial):
            return other is not None and trial is None
        ahead, its = other.fitter.foretold(other), trial.fitter.foretold(trial)
        return ahead is not None and (its is None or ahead.replaces(its, trial.fitter.offered))

    def zeros(self, trial: Trial) -> tuple[Tensor, Tensor] | None:
        """Zeros of sensors (B, n), fitted together with the numbers and states of a model, and their deviations.

        None where the model is at the noise, unless the settings ask for zeros, or where the fit leads nowhere.
        """
        wanted = self.config.find_zeros
        if len(self.data) == 1 or not (wanted or (wanted is None and not trial.at_the_noise)):
            return None
        names = trial.problem.parameters.numbers
        problem = trial.problem.of(names, trial.problem.sigma, trial.prior)
        return differing_zeros(problem, problem.pack(trial.theta, trial.path.x[:, 0, : problem.d]))

    def with_zeros(self, best: Trial | None, sure: bool = False) -> Zeroed:
        """The search of the sensors' readings less their zeros, and the model in it, where the score asks for them.

        `sure`: a part of these recordings has been found to have them, and the score is not asked.
        """
        differ = best and self.zeros(best)
        if best is None or differ is None or not (sure or bool(clear(*differ).any())):
            return self, best, None
        read = self.of(measured(self.data, differ[0].flatten().tolist()))
        other, more = read.again(best), (len(self.data) - 1) * self.data.dof
        if other is None or not (sure or other.fits_better(best, more)):
            return self, best, None
        return read, other, differ

    def zeros_again(self, read: Search, best: Trial, differ: tuple[Tensor, Tensor]) -> Zeroed:
        """The same with the zeros that this model asks for, which has been found with those of another one."""
        if (more := read.zeros(best)) is not None:
            zeros = differ[0] + more[0]
            other = self.of(measured(self.data, zeros.flatten().tolist()))
            if (found := other.again(best)) is not None:
                return other, found, (zeros, more[1])
        return read, best, differ

    def held(self, trial: Trial, holds: Sequence[str], *, alike: bool = False) -> str:
        """The hold that the same model asks for; "" for none. `alike`: by the residuals of the fits themselves."""
        best, found = trial, ""
        for hold in [] if trial.at_the_noise else [hold for hold in holds if hold != self.data.hold]:
            other = self.of(replace(self.data, hold=hold)).again(trial)
            if other is not None and (other.fits_better(best) if alike else other.replaces(best)):
                best, found = other, hold
        return found

    def driven_by(self, terms: Sequence[str]) -> Search:
        """The same of data whose inputs act by these terms as well: columns of u, and forces of the position."""
        forces = input_forces(terms)
        data = with_input_terms(self.data, columns_of(terms))
        base = estimate_baseline(data, outliers=self.freedom is not None)
        other = Search(data, base, replace(self.config, drag=forces), outliers=self.freedom is not None)
        other.order = self.order
        return other

    def input_terms(self, trial: Trial) -> tuple[str, ...]:
        """The terms of the inputs that a model with all of them among its offers has taken, if it is better."""
        return asked_terms(self, trial) if self.config.find_input_terms and not trial.at_the_noise else ()

    def braking(self, trial: Trial) -> Trial:
        """With a load in the place of dry friction that pushes, which would create energy, or with neither.

        What made up for it leaves then, and what it stood for joins.
        """
        braked = self._braked(trial)
        return trial if braked is trial else self._braked(self.settled(braked, swapped=True))

    @staticmethod
    def _braked(trial: Trial) -> Trial:
        """The same before other offers leave and join."""
        while pushing := trial.pushing:
            every = {offer.name for offer in (*trial.fitter.offers, *trial.fitter.loads)}
            loads = every & {f"load {i + 1}" for i in pushing.values()}
            taken = standing(trial.fitter.offers, trial.taken - set(pushing)) | loads
            other = trial.fitter.fit(taken, trial.values, trial.length, trial, 2 * ITERATIONS)
            if other is None:
                break
            trial = other
        return trial

    def stuck(self, trial: Trial | None) -> Trial | None:
        """With friction that can hold a joint still, where that is as likely."""
        dry = trial is not None and any(name.startswith(DRY) for name in trial.taken)
        if trial is None or not dry or self.config.sticking is False:
            return trial
        fitter = self.fitter(replace(trial.fitter.variant, sticking=True))
        least = LEAST_GRIP * max(self.base.speed)  # at 0 and below friction is none, and has no slope
        grip = {DRY: least, EXCESS: least / 100}
        values = {
            name: max(x, grip.get(name.split("[")[0], -math.inf)) if x != 0 else x for name, x in trial.values.items()
        }
        held = fitter.fit(trial.taken, values, trial.length, trial, 2 * ITERATIONS)
        if held is None or trial.replaces(held):
            return trial
        return self.settled(self.finer(held))
