"""Damping that depends on s, where a model without misses the data."""

from __future__ import annotations

from herglotz.models.config import POWERS
from herglotz.progress import MORE_TERMS, inside, part
from herglotz.training.search import Search
from herglotz.training.trials import ITERATIONS, Trial, Variant


@inside()
def with_dissipation(search: Search, best: Trial) -> Trial:
    """A model whose damping depends on s, where held-out time asks for it.

    A search is worth its time where s² makes a better model of this one, or this one follows nothing for long. One
    starts with s²: where s and its coefficient are 0, the motion changes with neither.
    """
    if best.at_the_noise or search.config.translations or search.config.sticking:
        return best
    part(MORE_TERMS)
    fitter, lowest = search.fitter(Variant(2, dissipation=tuple(POWERS))), next(iter(POWERS))
    asked = fitter.fit(best.taken | {lowest}, best.values, best.length, best, 2 * ITERATIONS)
    if best.whole and (asked is None or not asked.replaces(best)):
        return best
    for taken in (fitter.simple, fitter.simple | {lowest}):
        if (other := search.climbed(fitter, taken, {})) is not None:
            best = search.better(best, other) or best
            if other.at_the_noise:
                break
    return best
