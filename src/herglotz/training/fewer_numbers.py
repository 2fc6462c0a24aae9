"""A model that was found is tried with fewer numbers: what joints share, drag beside dry friction, a rate of each.

Each is fitted again. The simpler model stays where it is as likely, by the Bayesian information criterion, or where
residuals are no noise and held-out blocks of time do not ask for the richer one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from herglotz.data import Trajectories
from herglotz.progress import FEWER_NUMBERS, part
from herglotz.training.found_terms import Found
from herglotz.training.named_terms import NamedTerms
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.pruning import prune
from herglotz.training.subsets import best_of_each_size

# Numbers that each coordinate has whether the data ask for them or not.
OWN = ("potential.stiffness", "potential.tilt", "damping.rate", "friction.viscous", "coupling.viscous",
       "friction.input_map", "friction.input_zero")  # fmt: skip
SHARED = ("kinetic.off_diagonal", "kinetic.base.off_diagonal", "coupling.viscous")  # what joints that are apart lack
FEW = 10  # numbers of which all subsets are compared
HOPELESS = 1.5  # times what the fit and its long steps miss: terms that miss so much more are not fitted in short steps


@dataclass(frozen=True)
class FewerNumbers:
    """See the head of this module; `of` a found model is the one that stays."""

    data: Trajectories
    floor: float  # misfits below are rounding
    order: int  # of the rule
    refit: Callable[..., Found | None]  # with other terms, and model steps in a recorded one
    problem: Callable[..., tuple[object, ShootingProblem]]  # that such a fit solves

    def of(self, found: Found) -> Found:
        """The model with as few numbers as the data ask for."""
        part(FEWER_NUMBERS)
        return self._absent(self._one_rate(self._apart(self._undragged(found))))

    def _absent(self, found: Found) -> Found:
        """Without the springs, tilts, friction and inputs of single coordinates that say nothing."""
        if self.data.dof == 1 or not found.terms.springs:
            return found
        parameters, worth = found.fit.problem.parameters, math.log(self.data.q.numel())
        free = [i for i, name in enumerate(parameters.numbers) if name.startswith(OWN)]
        x, A = found.information(self.floor)
        kept = prune(A, x, torch.tensor(free, dtype=torch.long), worth)[0].tolist()
        less = found if len(kept) == len(free) else self._simplified(found, self._only(found, free, kept))
        if found.coloured or len(free) > FEW:
            return less
        most = 4**self.order * self.data.q.numel() / 2  # another valley may hold less than the quadratic model has it
        for few in best_of_each_size(A, x, free)[: len(kept)]:
            terms = self._only(found, free, [free[k] for k in few.kept])
            other = self.refit(found, terms) if few.criterion < most else None
            if other is not None and other.whole and other.as_likely(less, self.floor):
                less = other
        return less

    def _only(self, found: Found, free: Sequence[int], kept: Sequence[int]) -> NamedTerms:
        """Its terms, with those of these numbers absent that are not kept."""
        numbers = found.fit.problem.parameters.numbers
        absent = tuple(numbers[i] for i in free if i not in kept)
        return replace(found.terms, absent=(*found.terms.absent, *absent))

    def _one_rate(self, found: Found) -> Found:
        """With one rate for all coordinates, a contact model without forces, where its frictions say no more."""
        terms = found.terms
        if self.data.dof == 1 or terms.drag or terms.dry or found.config.level != "forced" or self.data.u is not None:
            return found
        absent = tuple(name for name in terms.absent if name.startswith("potential."))  # of frictions none is left
        return self._simplified(found, replace(terms, one_rate=True, absent=absent))

    def _undragged(self, found: Found) -> Found:
        """Without drag that joined while smooth friction stood for what holds the joints now, one by one."""
        for name in found.terms.drag if found.config.sticking else ():
            found = self._simplified(found, found.terms.only([x for x in found.terms.names if x != name]))
        return found

    def _apart(self, found: Found) -> Found:
        """Without constant masses and friction between joints, where these say no more."""
        if self.data.dof == 1 or not any(self.data.angles) or found.terms.apart:
            return found
        if found.cost_without(SHARED, self.floor) > 4**self.order * self.data.q.numel():
            return found  # a fit would only take its time
        absent = tuple(name for name in found.terms.absent if not name.startswith(SHARED))
        return self._simplified(found, replace(found.terms, apart=True, absent=absent))

    def _simplified(self, found: Found, terms: NamedTerms) -> Found:
        """With these terms, of fewer parameters, where they are as likely, or as good and residuals are no noise."""
        if found.config.substeps > 1 and self._hopeless(found, terms):
            return found
        less, count = self.refit(found, terms), self.data.q.numel()
        if less is None:
            return found
        fewer = (len(found.fit.theta) - len(less.fit.theta)) * math.log(count) / count
        likely = less.rms <= (1 + fewer) ** 0.5 * max(found.rms, self.floor)
        return less if likely or (found.coloured and less.as_good(found, self.floor)) else found

    def _hopeless(self, found: Found, terms: NamedTerms) -> bool:
        """Whether single model steps, which take less time, show that terms miss more than long steps explain."""
        less, longer = self.refit(found, terms, 1), self.problem(found, found.terms, 1)[1]
        return less is None or less.rms > HOPELESS * (max(found.rms, self.floor) + found.changed_by(longer))
