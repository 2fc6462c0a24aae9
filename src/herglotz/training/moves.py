"""Sets of offers that promise a better model than a fit, to first order: offers join or leave.

Sets are compared by the inequality of `score`. The residuals of held-out blocks come from the motion of the fit,
linearised in all numbers (`held_out`). All offers are scored in milliseconds; a fit of one offer takes as long.
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

# One offer of this many may leave in one step: 10 of 80 at once, and 1 of fewer than 16.
OFFERS_PER_REMOVAL = 8
# Largest number of values in the curvatures, and in the residuals, of the sets that are scored at once: 80 MB each.
MAX_VALUES_AT_ONCE = 10_000_000

Offers = frozenset[str]


class Moves:
    """Models with other offers than those of one fit, compared by their scores to first order."""

    def __init__(self, trial: Trial):
        self.trial, self.fitter, self.offered = trial, trial.fitter, trial.fitter.offered
        self.names = [offer.name for offer in self.fitter.offers]
        self.known: dict[Offers, Score] = {}

    @cached_property
    def _linear(self) -> tuple[HeldOut, dict[str, int]]:
        """The motion linearised in the numbers of all offers, and the index of each number."""
        trial, fitter = self.trial, self.fitter
        names = fitter.numbers({*self.names, *trial.taken})
        prior = fitter.prior(names, trial.scales)
        problem = trial.problem.of(names, trial.problem.sigma, prior)
        numbers = problem.parameters.numbers
        theta = trial.theta.new_tensor([trial.values[name] for name in numbers])
        places = {name: i for i, name in enumerate(numbers)}
        # An offer leaves when its amplitudes become 0.
        leaving, offers = torch.zeros_like(theta), (*fitter.offers, *fitter.loads)
        amplitudes = [places[name] for offer in offers for name in offer.amplitudes if name in places]
        leaving[amplitudes] = -theta[amplitudes]
        fitted = [places[name] for name in trial.problem.parameters.numbers]
        return HeldOut(problem, trial.path, theta, fitted, leaving, fitter.waves(prior, numbers)), places

    def scores(self, sets: Iterable[Offers]) -> list[Score]:
        """Scores of models with these sets of offers; each set is computed once."""
        sets = list(sets)
        new = [offers for offers in dict.fromkeys(sets) if offers not in self.known]
        self.known.update(zip(new, self._in_parts(new), strict=True))
        return [self.known[offers] for offers in sets]

    def _in_parts(self, sets: Sequence[Offers], *, rough: bool = False) -> list[Score]:
        """The scores, of so many sets at once as `MAX_VALUES_AT_ONCE` allows."""
        curvatures = BLOCKS * max((len(self.fitter.numbers(offers)) for offers in sets), default=0) ** 2
        size = max(1, MAX_VALUES_AT_ONCE // max(curvatures, self.fitter.data.q.numel()))
        parts = [sets[k : k + size] for k in range(0, len(sets), size)]
        return [score for part in parts for score in self.computed(part, rough=rough)]

    def computed(self, sets: Sequence[Offers], *, rough: bool = False) -> list[Score]:
        """Scores of models with these sets of offers by the linearised motion; `rough` as in `score.scores`."""
        (model, places), count = self._linear, self.trial.problem.data.q.numel()
        numbers = [[places[name] for name in self.fitter.numbers(offers)] for offers in sets]
        return scores(model, numbers, [len(offers) for offers in sets], count, self.fitter.floor, rough=rough)

    def start(self, offers: Offers) -> tuple[dict[str, float], Tensor | None]:
        """The values of all numbers and the start states (S, d) from which a fit with these offers begins.

        If segments are joined, or if the linear step is not finite, the values are those of this fit and the states
        are None: the linearised motion has no joints.
        """
        trial, (model, places) = self.trial, self._linear
        numbers, starts = model.steps([places[name] for name in self.fitter.numbers(offers)])
        if trial.problem.jointed or not bool(torch.isfinite(numbers).all() and torch.isfinite(starts).all()):
            return trial.values, None
        values = {name: trial.values[name] + float(numbers[i]) for name, i in places.items()}
        return trial.values | values, trial.path.x[:, 0, : trial.problem.d] + starts

    def joining(self, at: Offers) -> list[Offers]:
        """Sets better than `at` with one more offer and the offer that it depends on, the best first."""
        others = [offer for offer in self.fitter.offers if offer.name not in at]
        return self._better(at, [at | {offer.name, offer.on or offer.name} for offer in others])

    def _without(self, at: Offers, gone: Collection[str]) -> Offers:
        """The offers `at` without those in `gone` and without offers that depend on them."""
        return standing(self.fitter.offers, at - set(gone))

    def _better(self, at: Offers, sets: list[Offers]) -> list[Offers]:
        """The sets that replace `at`, the best first."""
        (now,) = self.scores([at])
        # Fits to all samples take as long as all the rest, and cannot make up for the standard error of the losses.
        rough = zip(sets, self._in_parts(sets, rough=True), strict=True)
        sets = [offers for offers, score in rough if score.clearly_better(now)]
        found = [(score.gain(now, self.offered), other) for other, score in zip(sets, self.scores(sets), strict=True)]
        return [other for gain, other in sorted(found, key=lambda x: -x[0]) if gain > 0]

    def leaving(self, at: Offers) -> list[Offers]:
        """The smallest set of offers that is as good as `at`, then sets halfway and nearer to `at`.

        Offers leave in the order of their worth, the least first, until the loss exceeds the price of all that stay.
        """
        (best,), now, path, steps = self.scores([at]), at, [], 0
        while names := [name for name in self.names if name in now]:
            gains = [
                best.gain(score, self.offered) for score in self.scores([self._without(now, {name}) for name in names])
            ]
            order = [name for _, name in sorted(zip(gains, names, strict=True))]
            count = max(1, min(len(names) // OFFERS_PER_REMOVAL, sum(gain <= 0 for gain in gains)))
            # All `count` offers leave at once or, if the model is then worse, half of them, a quarter, … one.
            smaller = [self._without(now, order[: count >> k]) for k in range(count.bit_length())]
            scores = dict(zip(smaller, self.scores(smaller), strict=True))
            now = next((offers for offers in smaller if best.gain(scores[offers], self.offered) <= 0), smaller[-1])
            path.append(now)
            if (gain := best.gain(scores[now], self.offered)) <= 0:
                best, steps = scores[now], len(path)
            # Removing all other offers would not earn back this loss.
            elif gain > best.price(scores[now], self.offered):
                break
        # The sets after all steps of the path, half of them, a quarter, …
        return [path[(steps >> k) - 1] for k in range(steps.bit_length())]
