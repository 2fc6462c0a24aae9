"""The named terms that a recording needs: one linear problem, then whole trajectories with terms added and left out.

The linear problem (`linear_start`) is made of smoothed positions (`data.smoothing`), and pruned. From there
trajectories are fitted by multiple shooting. The candidate that lowers the cost most, by the quadratic model of the
fit, joins while that is more than ½ log N (the Bayesian information criterion); at the end those that lower it by less
leave, and of one coordinate all subsets are compared (`subsets`). That criterion takes residuals for white noise. Where
they are none, and of one coordinate always, terms stay only if held-out blocks of time ask for them. Model steps are
halved while that changes the motion by a good part of what it misses the data by.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.roughness import AT_THE_NOISE, coarse, precision, sparsest
from herglotz.data.smoothing import LocalPolynomials, local_polynomials, smoothed
from herglotz.progress import FEWER_TERMS, FIRST_TERMS, MORE_TERMS, inside, part
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.exchange import exchanged
from herglotz.training.fewer_numbers import FewerNumbers
from herglotz.training.found_terms import Found, gain
from herglotz.training.linear_terms import LinearStart, starts_of
from herglotz.training.named_terms import (
    DRY,
    NamedTerms,
    candidates,
    loads,
    offered,
    own_terms,
    same_as_friction,
    settings_of,
    started,
    values_of,
    without_terms,
)
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.prior import prior_of
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.stages import Stages
from herglotz.training.subsets import likelier, missing, preferred
from herglotz.training.task import EXACT, Task, build_model, with_sticking
from herglotz.training.trajectory_fit import SegmentStages, TrajectoryFit

PART = 2000  # samples that a search begins with, where there are more than twice as many
ADDED = 12  # rounds in which a term may join; one goes to friction that turns out to push
FINER = 0.3  # halved steps that change the motion by more than this share of the misfit are worth their time
BETTER = 0.8  # of the misfit at which shorter steps were in vain: other terms ask for them again
FINEST = 16  # model steps in a recorded one
STEPS = 40_000  # model steps of all trajectories together
MISLED = 1.5  # times the precision: a linear start that leaves so much may be worse than one without its terms
ROUNDING = 3.0  # times the σ of exact data: smaller misfits and changes are no reason for a term or a step
FINE = 0.1  # of the misfit that is rounding: steps of exact data that change the motion by less do not show in it
EXCESS, EXCESS_START = "friction.breakaway", 0.1  # of Coulomb's force: where a fit of Stribeck's excess starts
SHAPES = 3  # numbers that smooth dry friction has beside Coulomb's force: its width, Stribeck's excess and its width
SMOOTH = 1e-3  # of the spread: data that are more precise are worth a rule of order 4


class DictionarySearch:
    """See the head of this module: `data` to train on, the first look `base` at them, and the settings of the fit.

    With `outliers` Student's t is the loss. Of `every`-th samples the linear problem alone is made of all that are
    recorded.
    """

    def __init__(self, data: Trajectories, base: Baseline, config: FitConfig, outliers: bool = False, every: int = 1):
        self.recorded, self.every, self.base, self.config = data, every, base, config
        self.data = data = data if every == 1 else data.thinned(every)
        self.freedom = FREEDOM if outliers else None
        self.all = candidates(data, config.translations)
        self.own = own_terms(data.angles)
        self.spread = float(((data.q - data.q.mean(0)) / data.balance).square().mean().sqrt())
        self.floor = ROUNDING * EXACT[config.dtype] * max(base.scale)
        self.precision = precision(data)
        self.noise = self.precision if math.isfinite(self.precision) else 0.0  # what is gained below it is noise
        self.finest = min(FINEST, STEPS // data.samples)
        self.in_vain = (0, None), 0.0  # model steps in a recorded one, sticking, and the misfit that stayed
        plain = data.u is None or data.dof == 1  # joints with motors: inputs and dry friction jump, and steps cost more
        self.coarse = coarse(data)
        self.order = 4 if plain and (self.coarse or self.precision < SMOOTH * self.spread) else 2

    @inside()
    def run(self) -> Found | None:
        """The model that the data ask for; None where not even the shortest segments can be followed."""
        part(FIRST_TERMS)
        every = sparsest(self.data)
        found = None if every == 1 else self._from_sparse(every)
        if found is not None and found.coloured:
            return found  # more samples do not tell what a term is missing that this many do not show
        if found is None:
            few = self.data.liveliest(PART)
            found = self._begun() if few.samples > self.data.samples / 2 else self._from_part(few)
            if found is None:
                return None
        part(MORE_TERMS)
        found = self._braking(found) if found.pushes else found
        self.all = offered(self.data, self.all, found.terms, lacks=all((found.coloured, found.rms > self.floor)))
        self.all = replace(self.all, apart=found.terms.apart)
        for _ in range(ADDED):
            name = self._missing(found)
            more = None if name is None else self.refit(found, self.all.only((*found.terms.names, name)))
            if name == DRY and more is not None and more.pushes:
                self.all = replace(self.all.joined(NamedTerms((), loads(self.data, one_way=True))), dry=False)
                continue
            if more is None or not found.joined_by(more, self.floor):
                break
            found = self._finer(self._held(self._longer(more)))
        part(FEWER_TERMS)
        found = exchanged(self._pruned(found), self.all, self.refit, self._missing, self.floor)
        found = self._last_terms(self._likeliest(found))
        return FewerNumbers(self.data, self.floor, self.order, self.refit, self._problem).of(found)

    def _begun(self) -> Found | None:
        """The terms of one linear problem, fitted to segments that grow."""
        if (local := local_polynomials(self.recorded)) is None:
            return None
        start = smoothed(self.recorded, local).thinned(self.every)
        found, simpler = self._first(start, local)
        if found is None:
            return None
        for simple in simpler:
            other = self._grown(simple.terms, simple.values, start)
            other = None if other is None else self._finer(self._held(other))
            if other is not None and other.instead_of(found, self.floor):
                return other
        return found

    def _first(self, start: Trajectories, local: LocalPolynomials) -> tuple[Found | None, Sequence[LinearStart]]:
        """From the linear problem, or from the baseline's own terms where that misleads; then starts of fewer terms."""
        bare = self._bare(start) if self.coarse and self.data.dof == 1 else None
        if bare is not None and bare.whole and bare.rms <= self.precision:
            return self._finer(bare), []  # accelerations that are read off coarse samples mislead
        linear = starts_of(self.recorded, self.base, self.all, local)
        grown = ((self._grown(of, x.values, start), at) for at, x in enumerate(linear, 1) for of in x.ways)
        found, at = next((pair for pair in grown if pair[0] is not None), (None, 0))
        if bare is None and self._misled(found):
            bare = self._bare(start)
        if bare is not None and bare.misses_less(found):
            found, linear = bare, []
        return (found, []) if found is None else (self._finer(self._held(self._simpler(found))), linear[at:])

    def _misled(self, found: Found | None) -> bool:
        """Whether the linear problem gave no model, or one coordinate's that misses far more than the noise."""
        return found is None or (self.data.dof == 1 and found.coloured and found.rms > MISLED * self.precision)

    def _from_part(self, part: Trajectories) -> Found | None:
        """What a part of the data asks for, fitted to all of them: a search costs many fits."""
        search = DictionarySearch(part, self.base, self.config, outliers=self.freedom is not None)
        found, local = search.run(), local_polynomials(self.data)
        if found is None or local is None:
            return None
        self.order = search.order
        stages = self._stages(found.terms, found.values, found.config.substeps, found.config.sticking)
        stages.hurried, sigma, begin = True, max(found.rms, self.floor), smoothed(self.data, local)
        fit = stages.at_once(sigma, self.freedom, begin) if found.whole else None
        if fit is None or not fit.follows(sigma):
            first = stages.fit(stages.lengths[0], sigma, self.freedom, None, begin=begin)
            fit = None if first is None else stages.grow(first, sigma)
        return None if fit is None else self._found(found.terms, stages, fit)

    def _from_sparse(self, every: int) -> Found | None:
        """What every m-th sample asks for, fitted to all of them."""
        base = replace(self.base, max_step=every * self.base.max_step, model_step=every * self.base.model_step)
        search = DictionarySearch(self.data, base, self.config, outliers=self.freedom is not None, every=every)
        found = search.run()
        if found is None:
            return None
        if (kept := search.kept_of(found, every)) > 1:
            base = replace(found.base, max_step=self.base.max_step, model_step=self.base.model_step)
            return replace(found, every=kept, base=base, config=replace(found.config, substeps=1))
        self.order = found.config.order
        dense = self.refit(found, found.terms, max(1, found.config.substeps // every), every)
        return None if dense is None else self._longer(dense)

    def kept_of(self, found: Found, every: int) -> int:
        """How many of so many times more samples are one that tells enough; 1: all of them are to be fitted.

        More tell nothing where a force is missing. Halved steps err by a quarter, for friction is of order 2; they may
        change the motion by a quarter of what a search allows, for free runs are longer than its segments.
        """
        known = found.rms <= max(AT_THE_NOISE * self.noise, self.floor)
        if not found.coloured or known or self.config.find_zeros:  # zeros are small, and every sample tells of them
            return 1
        change = 4 * found.changed_by(self._problem(found, found.terms, every)[1]) / (FINER * found.rms)
        halvings = math.ceil(math.log(max(change, 1.0), 4)) if math.isfinite(change) else every
        return max(1, every // (found.config.substeps * 2**halvings))

    def _bare(self, start: Trajectories) -> Found | None:
        return self._grown(*without_terms(self.all, self.base), start)

    def _braking(self, found: Found) -> Found:
        """Without its dry friction, which pushes: it makes up for another force, which may be a load."""
        same = same_as_friction(self.data, found.values[DRY])
        terms = replace(found.terms.joined(NamedTerms((), tuple(same))), dry=False)
        return self.refit(replace(found, values=found.values | same), terms) or found

    def _held(self, found: Found) -> Found:
        """With dry friction that can hold a joint still, unless smooth friction is worth its widths and its excess."""
        if not found.terms.dry or found.pushes or found.config.sticking or self.config.sticking is False:
            return found
        count, plain = self.data.q.numel(), self._sticking(found, 0.0)
        plain = plain and self._finer(plain, longer=False)  # where a joint turns back its steps are of order 1
        worth = self.data.dof * math.log(count) / 2  # of one number for each coordinate
        if plain is None or (gain(plain.rms, found.rms, count, self.floor) > SHAPES * worth and plain.rms > self.noise):
            return found
        held = self._sticking(plain, max(plain.values[DRY]) * EXCESS_START)
        shaped = 0.0 if held is None else gain(plain.rms, held.rms, count, self.floor)
        return self._longer(held if held is not None and shaped > (SHAPES - 1) * worth else plain)

    def _sticking(self, found: Found, excess: float) -> Found | None:
        """The fit with set-valued friction, from this excess at breakaway; at 0 there is none."""
        values, config = {**found.values, EXCESS: (excess,) * self.data.dof}, replace(found.config, sticking=True)
        return self.refit(replace(found, values=values, config=config), found.terms)

    def _stages(self, terms: NamedTerms, values: dict, substeps: int, sticking: bool | None) -> SegmentStages:
        config = settings_of(terms, self.data, self.config, self.order, substeps)
        config = replace(config, sticking=bool(sticking) and terms.dry)
        base = started(self.base, self.data, values, config)
        task = Task(self.data, base, config, Stages())
        model = build_model(base, config, "none")
        return SegmentStages(task, with_sticking(model, excess=EXCESS not in values) if config.sticking else model)

    def _found(self, terms: NamedTerms, stages: SegmentStages, fit: TrajectoryFit) -> Found:
        task = stages.task
        values = values_of(fit.problem.parameters, fit.theta)
        whole = fit.problem.grid.segments == len(self.data) and fit.noise < self.spread
        base = started(task.base, self.data, values, task.config)
        return Found(terms, task.config, values, base, fit, whole, self.spread)

    def _grown(self, terms: NamedTerms, values: dict, start: Trajectories) -> Found | None:
        """From the shortest segments to the longest that the model follows."""
        stages = self._stages(terms, values, 1, self.config.sticking)
        stages.hurried = True
        sigma = max(min(self.precision, self.spread), self.floor)
        first = stages.fit(stages.lengths[0], sigma, self.freedom, None, begin=start)
        if first is None or not first.noise < self.spread:
            return None
        return self._found(terms, stages, stages.grow(first, max(first.noise, self.floor)))

    def _longer(self, found: Found) -> Found:
        """The same terms over longer segments, where the model follows the data now."""
        if found.whole:
            return found
        stages = self._stages(found.terms, found.values, found.config.substeps, found.config.sticking)
        stages.hurried = True
        stages.lengths = [0, *(length for length in stages.lengths if length > found.fit.problem.grid.length)]
        return self._found(found.terms, stages, stages.grow(found.fit, max(found.rms, self.floor)))

    def _problem(
        self, found: Found, terms: NamedTerms, substeps: int, every: int = 1
    ) -> tuple[SegmentStages, ShootingProblem]:
        """The problem with other terms over the same segments; `found` may be of every m-th sample."""
        stages = self._stages(terms, found.values, substeps, found.config.sticking)
        old, base = found.fit.problem, stages.task.base
        grid = segment_grid(self.data, every * old.grid.length, base.model_step)
        model = stages.model
        problem = ShootingProblem(
            model, self.data, grid, sigma=max(found.rms, self.floor), prior=prior_of(model, base, None),
            freedom=self.freedom,
        )  # fmt: skip
        problem.guess_from(old, found.fit.path)
        problem.patient = False
        return stages, problem

    def refit(
        self, found: Found, terms: NamedTerms, substeps: int | None = None, every: int = 1, states: Tensor | None = None
    ) -> Found | None:
        """The fit with other terms, steps or samples, from this one, or from these states (S, d) of its segments."""
        stages, problem = self._problem(found, terms, substeps or found.config.substeps, every)
        assert problem.path is not None
        states = problem.path.x[:, 0, : problem.d] if states is None else states
        fit = stages.optimise(problem, problem.parameters.get(), states, "terms", near=True)
        return None if fit is None else self._found(terms, stages, fit)

    def _missing(self, found: Found) -> str | None:
        """The term whose absence costs most, where that is more than it may; None where none does."""
        none = set(self.all.names) <= set(found.terms.names) or found.rms <= self.floor  # any term lowers rounding
        return None if none else missing(found, self._problem(found, self.all, found.config.substeps)[1], self.all)

    def _pruned(self, found: Found) -> Found:
        """Without the terms that the fit does not lose by, were residuals white noise."""
        count = self.data.q.numel()
        terms = found.needed(math.log(count), self.own, self.floor)
        less = None if terms == found.terms else self.refit(found, terms)
        allowed = (1 + len(found.terms.names) * math.log(count) / count) ** 0.5
        return less if less is not None and less.rms <= allowed * max(found.rms, self.floor) else found

    def _likeliest(self, found: Found) -> Found:
        """With the subset of one coordinate's candidates that the criterion prefers, where residuals are noise."""
        if self.data.dof > 1 or not found.terms.names or (found.coloured and found.rms > self.floor):
            return found
        _, problem = self._problem(found, self.all, found.config.substeps)
        for better in likelier(found, problem, self.all, self.floor):
            other = self.refit(replace(found, values=better.values), better.terms, states=better.states)
            if other is not None and not other.pushes and preferred(other, found, len(self.all.names), self.floor):
                return self._likeliest(self._held(self._longer(other)))
        return found

    def _simpler(self, found: Found) -> Found:
        """Without terms that make up for steps that are too long, where residuals are no noise."""
        count = self.data.q.numel()
        for worth in (4**self.order * count, count):  # as much as halved steps may bring, then twice the misfit
            terms = found.needed(worth, self.own, self.floor)
            less = None if terms == found.terms or not found.coloured else self.refit(found, terms)
            if less is None or less.rms > (1 + worth / count) ** 0.5 * max(found.rms, self.floor):
                continue  # far from the minimum it costs more
            less = self._finer(less)
            if less.as_good(found, self.floor):
                return less
        return found

    def _last_terms(self, found: Found) -> Found:
        """Without terms that held-out blocks do not ask for: of several coordinates where residuals are no noise."""
        first, worth = found, 4**self.order * self.data.q.numel()
        while found.terms.names and (found.coloured or (self.data.dof == 1 and found.rms > self.floor)):
            terms = found.needed(worth, self.own, self.floor, one_less=True)
            less = None if terms == found.terms else self.refit(found, terms)
            less = None if less is None else self._finer(less)  # the term may have made up for the steps' length
            if less is None or not less.as_good(found if found.coloured else first, self.floor):
                break
            found = less
        return found

    def _finer(self, found: Found, *, longer: bool = True) -> Found:
        """With as many model steps in a recorded one as the misfit asks for, over `longer` segments where it can be."""
        while self._too_long(found):
            m, of = found.config.substeps, found
            tried = (2 * m,) if of.halved_before else (2 * m, 4 * m)
            finer = (self.refit(of, of.terms, shorter) for shorter in tried if shorter <= self.finest)
            other = next((f for f in finer if f is not None and of.worth_halving(f, FINE * self.floor)), None)
            if other is None:
                self.in_vain = (m, found.config.sticking), found.rms
                break  # the terms make up for the longer steps
            found = self._longer(other) if longer else other
        return found

    def _too_long(self, found: Found) -> bool:
        """Whether halved steps, which there may be, change the motion by as much as the data miss it."""
        m = found.config.substeps
        vain = self.in_vain[0] == (m, found.config.sticking) and found.rms > BETTER * self.in_vain[1]
        if vain or 2 * m > self.finest or found.rms <= FINE * self.floor:
            return False
        return found.changed_by(self._problem(found, found.terms, 2 * m)[1]) > max(FINER * found.rms, FINE * self.floor)
