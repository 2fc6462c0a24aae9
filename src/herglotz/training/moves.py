"""Better sets of offers than a fit has taken, to first order: offers that join, that leave, and exchanges.

Every set is compared by the one inequality of `score`, its held-out blocks being foretold by the linear motion of the
fit (`held_out`): that is a matter of milliseconds for all offers, where fits take as long for one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from functools import cached_property

import torch
from torch import Tensor

from herglotz.training.held_out import BLOCKS, HeldOut
from herglotz.training.offers import standing
from herglotz.training.score import Score, scores
from herglotz.training.trials import Trial

AT_ONCE = 8  # offers of which one leaves at once: of 80 ten, of fewer than 16 one
MEMORY = 10_000_000  # numbers in the curvatures, and in the residuals, of sets that are compared at once: 80 MB

Offers = frozenset[str]


class Moves:
    """Models with the offers of one fit, by their scores to first order."""

    def __init__(self, trial: Trial):
        self.trial, self.fitter, self.offered = trial, trial.fitter, trial.fitter.offered
        self.names = [offer.name for offer in self.fitter.offers]
        self.known: dict[Offers, Score] = {}

    @cached_property
    def _linear(self) -> tuple[HeldOut, dict[str, int]]:
        """The motion, linear in the numbers of all offers, and the places of these."""
        trial, fitter = self.trial, self.fitter
        names = fitter.numbers({*self.names, *trial.taken})
        prior = fitter.prior(names, trial.scales)
        problem = trial.problem.of(names, trial.problem.sigma, prior)
        numbers = problem.parameters.numbers
        theta = trial.theta.new_tensor([trial.values[name] for name in numbers])
        places = {name: i for i, name in enumerate(numbers)}
        leaving, every = torch.zeros_like(theta), (*fitter.offers, *fitter.loads)
        own = [places[name] for offer in every for name in offer.amplitudes if name in places]
        leaving[own] = -theta[own]
        fitted = [places[name] for name in trial.problem.parameters.numbers]
        return HeldOut(problem, trial.path, theta, fitted, leaving, fitter.waves(prior, numbers)), places

    def scores(self, sets: Iterable[Offers]) -> list[Score]:
        """Of models with these sets of offers."""
        sets = list(sets)
        new = [own for own in dict.fromkeys(sets) if own not in self.known]
        curvatures = BLOCKS * max((len(self.fitter.numbers(own)) for own in new), default=0) ** 2
        many = max(1, MEMORY // max(curvatures, self.fitter.data.q.numel()))
        for k in range(0, len(new), many):
            part = new[k : k + many]
            self.known.update(zip(part, self.foretold(part), strict=True))
        return [self.known[own] for own in sets]

    def foretold(self, sets: Sequence[Offers]) -> list[Score]:
        """The same without a memory."""
        (model, places), count = self._linear, self.trial.problem.data.q.numel()
        numbers = [[places[name] for name in self.fitter.numbers(own)] for own in sets]
        return scores(model, numbers, [len(own) for own in sets], count, self.fitter.floor)

    def start(self, offers: Offers) -> tuple[dict[str, float], Tensor | None]:
        """The values of all numbers and the starts (S, d) of a model with these offers.

        Over segments with joints, which this motion knows nothing of, they are those of the fit (None).
        """
        trial, (model, places) = self.trial, self._linear
        numbers, starts = model.steps([places[name] for name in self.fitter.numbers(offers)])
        if trial.problem.jointed or not bool(torch.isfinite(numbers).all() and torch.isfinite(starts).all()):
            return trial.values, None
        values = {name: trial.values[name] + float(numbers[i]) for name, i in places.items()}
        return trial.values | values, trial.path.x[:, 0, : trial.problem.d] + starts

    def joining(self, at: Offers) -> list[Offers]:
        """With one more offer, and what it is of, the best first; none that is not better."""
        own = [offer for offer in self.fitter.offers if offer.name not in at]
        return self._better(at, [at | {offer.name, offer.on or offer.name} for offer in own])

    def exchanges(self, at: Offers) -> list[Offers]:
        """With one offer in the place of another, the best first; none that is not better."""
        pairs = [(new, old) for old in self.names if old in at for new in self.names if new not in at]
        return self._better(at, [self._without(at | {new}, {old}) for new, old in pairs])

    def _without(self, at: Offers, gone: Collection[str]) -> Offers:
        """What is left where some offers leave."""
        return standing(self.fitter.offers, at - set(gone))

    def _better(self, at: Offers, sets: list[Offers]) -> list[Offers]:
        """Those that replace `at`, the best first."""
        (own,) = self.scores([at])
        found = [(score.gain(own, self.offered), other) for other, score in zip(sets, self.scores(sets), strict=True)]
        return [other for gain, other in sorted(found, key=lambda x: -x[0]) if gain > 0]

    def leaving(self, at: Offers) -> list[Offers]:
        """The fewest offers that are as good, and some on the way: the one that is missed least leaves first."""
        (best,), now, way, most = self.scores([at]), at, [], 0
        while names := [name for name in self.names if name in now]:
            gains = [
                best.gain(score, self.offered) for score in self.scores([self._without(now, {name}) for name in names])
            ]
            order = [name for _, name in sorted(zip(gains, names, strict=True))]
            many = max(1, min(len(names) // AT_ONCE, sum(gain <= 0 for gain in gains)))
            parts = [self._without(now, order[: many >> k]) for k in range(many.bit_length())]  # all of these, half …
            scores = dict(zip(parts, self.scores(parts), strict=True))
            now = next((own for own in parts if best.gain(scores[own], self.offered) <= 0), parts[-1])
            way.append(now)
            if (gain := best.gain(scores[now], self.offered)) <= 0:
                best, most = scores[now], len(way)
            elif gain > best.price(scores[now], self.offered):  # more than all that may still leave are worth
                break
        return [way[(most >> k) - 1] for k in range(most.bit_length())]  # all of the way, half, a quarter …
