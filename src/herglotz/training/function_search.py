"""Learned functions beside named terms, for data that named terms alone do not follow to the noise."""

from __future__ import annotations

from dataclasses import replace

from herglotz.progress import MORE_TERMS, inside, part
from herglotz.training.search import Search
from herglotz.training.trials import ITERATIONS, Trial, Variant, likeliest, scores_of


@inside()
def with_functions(search: Search, best: Trial) -> Trial:
    """A model with functions if that is better than `best`, otherwise `best`.

    If `best` is near the data (`Trial.near`), functions join like all offers, by the linearised motion. Otherwise they
    join the simplest model, from the shortest segments on. If the result is not at the noise, the model of all
    functions competes (`Search.flexible`), settled.
    """
    if best.lacks_nothing or search.config.translations:
        return best
    part(MORE_TERMS)
    found = search.better(best, _joined(search, best) if best.near else _anew(search)) or best
    flexible = None if found.at_the_noise else search.flexible
    if flexible is not None and flexible.foretells(found):
        found = search.better(found, search.pared(flexible)) or found
    return found if found.taken & set(found.fitter.functions) else best


def _joined(search: Search, best: Trial) -> Trial | None:
    """The model `best` with functions that join one by one or, if the result still lacks something, all at once.

    The model with all functions, at their likeliest prior variances, is kept only if its held-out log-loss is below
    that of `best`. None if `best` cannot be fitted with the dictionary that has all functions.
    """
    if (fitter := search.fitter_of_functions(replace(best.fitter.variant, kept=best.taken))) is None:
        return None
    taken = best.taken & {offer.name for offer in (*fitter.offers, *fitter.loads)}
    # A named term that is a wave of a function is in the model only with the band of that wave.
    taken |= {own.name for own in fitter.variant.functions if best.taken & set(own.texts)}
    same = fitter.fit(taken, fitter.values_of(best), best.length, best)
    found = same and search.settled(search.finer(same))
    if found is None or found.lacks_nothing:
        return found
    # A pendulum whose length turns with it needs mass, potential and damping together.
    every = fitter.fit({*taken, *fitter.functions}, fitter.values_of(best), best.length, best, 2 * ITERATIONS)
    every = every and likeliest(every, 2 * ITERATIONS)
    if every is None:
        return found
    before, after = scores_of(best, every)
    if not float((before.losses - after.losses).sum()) > 0:
        return found
    return search.better(found, search.settled(every))


def _anew(search: Search) -> Trial | None:
    """The simplest model with functions that join, from the shortest segments on."""
    fitter = search.fitter_of_functions(Variant(search.order))
    return fitter and search.climbed(fitter, fitter.simple, {})
