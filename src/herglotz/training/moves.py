"""Better sets of offers than a fit has taken, to first order: offers that join, that leave, and exchanges.

Every set is compared by the one inequality of `score`, its held-out blocks being foretold by the linear motion of the
fit (`held_out`): that is a matter of milliseconds for all offers, where fits take as long for one.
"""

from __future__ import annotations

from collections.abc import Iterable

from herglotz.training.held_out import BLOCKS
from herglotz.training.score import Score
from herglotz.training.trials import Trial

AT_ONCE = 8  # offers of which one leaves at once: of 80 ten, of fewer than 16 one
MEMORY = 10_000_000  # numbers in the curvatures of sets that are compared at once: 80 MB

Offers = frozenset[str]


class Moves:
    """Models with the offers of one fit, by their scores to first order."""

    def __init__(self, trial: Trial):
        self.trial, self.offered = trial, trial.fitter.offered
        self.names = [offer.name for offer in trial.fitter.offers]
        self.known: dict[Offers, Score] = {}

    def scores(self, sets: Iterable[Offers]) -> list[Score]:
        """Of these sets of offers."""
        sets = list(sets)
        new = [own for own in dict.fromkeys(sets) if own not in self.known]
        many = max(1, MEMORY // (BLOCKS * (1 + max(map(len, new), default=0)) ** 2))
        for k in range(0, len(new), many):
            part = new[k : k + many]
            self.known.update(zip(part, self.trial.scored(part), strict=True))
        return [self.known[own] for own in sets]

    def joining(self, at: Offers) -> list[Offers]:
        """With one more offer, the best first; none that is not better."""
        return self._better(at, [at | {name} for name in self.names if name not in at])

    def exchanges(self, at: Offers) -> list[Offers]:
        """With one offer in the place of another, the best first; none that is not better."""
        pairs = [(new, old) for old in self.names if old in at for new in self.names if new not in at]
        return self._better(at, [at - {old} | {new} for new, old in pairs])

    def _better(self, at: Offers, sets: list[Offers]) -> list[Offers]:
        """Those that replace `at`, the best first."""
        (own,) = self.scores([at])
        found = [(score.gain(own, self.offered), other) for other, score in zip(sets, self.scores(sets), strict=True)]
        return [other for gain, other in sorted(found, key=lambda x: -x[0]) if gain > 0]

    def leaving(self, at: Offers) -> list[Offers]:
        """The fewest offers that are as good, and some on the way: the one that is missed least leaves first."""
        (best,), now, way, most = self.scores([at]), at, [], 0
        while names := [name for name in self.names if name in now]:
            gains = [best.gain(score, self.offered) for score in self.scores([now - {name} for name in names])]
            order = [name for _, name in sorted(zip(gains, names, strict=True))]
            many = max(1, min(len(names) // AT_ONCE, sum(gain <= 0 for gain in gains)))
            parts = [now - set(order[: many >> k]) for k in range(many.bit_length())]  # all of these, half …
            scores = dict(zip(parts, self.scores(parts), strict=True))
            now = next((own for own in parts if best.gain(scores[own], self.offered) <= 0), parts[-1])
            way.append(now)
            if (gain := best.gain(scores[now], self.offered)) <= 0:
                best, most = scores[now], len(way)
            elif gain > scores[now].price(self.offered):  # more than all that may still leave are worth
                break
        return [way[(most >> k) - 1] for k in range(most.bit_length())]  # all of the way, half, a quarter …
