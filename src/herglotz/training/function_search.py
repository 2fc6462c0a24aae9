"""Learned functions beside named terms, for data that named terms alone do not follow to the noise."""

from __future__ import annotations

from dataclasses import replace

from herglotz.progress import MORE_TERMS, inside, part
from herglotz.training.functions import bands
from herglotz.training.kernel import MAX_PARAMETERS
from herglotz.training.search import Search
from herglotz.training.trials import ITERATIONS, Fitter, Trial, Variant, likeliest


@inside()
def with_functions(search: Search, best: Trial) -> Trial:
    """A model with functions if that is better than `best`, otherwise `best`.

    If `best` is near the data (`Trial.near`), functions join like all offers, by the linearised motion. Otherwise a
    model of functions is fitted anew, from the shortest segments on.
    """
    if best.at_the_noise or search.config.translations:
        return best
    part(MORE_TERMS)
    found = _joined(search, best) if best.near else None
    found = _anew(search) if found is None else found
    if found is None or not found.taken & set(found.fitter.functions):
        return best
    return search.better(best, found) or best


def _fitter(search: Search, variant: Variant) -> Fitter | None:
    """The fitter of a variant with all functions; None if they have more numbers than a kernel may have."""
    fitter = search.fitter(replace(variant, functions=tuple(bands(search.range_data, search.base))))
    return fitter if len(fitter.start) <= MAX_PARAMETERS else None


def _joined(search: Search, best: Trial) -> Trial | None:
    """The model `best` with functions that join one by one or, if the result is not at the noise, all at once.

    The model with all functions is fitted further only if its held-out log-loss is below that of `best`. None if
    `best` cannot be fitted with the dictionary that has all functions.
    """
    if (fitter := _fitter(search, replace(best.fitter.variant, kept=best.taken))) is None:
        return None
    taken = best.taken & {offer.name for offer in (*fitter.offers, *fitter.loads)}
    # A named term that is a wave of a function is in the model only with the band of that wave.
    taken |= {own.name for own in fitter.variant.functions if best.taken & set(own.texts)}
    same = fitter.fit(taken, fitter.values_of(best), best.length, best)
    found = same and search.settled(search.finer(same), swapped=True)
    if found is None or found.at_the_noise:
        return found
    # The row open 5417/6 of `benchmarks/judge.py` needs this fit: without it no model is found, with it a poor one.
    every = fitter.fit({*taken, *fitter.functions}, fitter.values_of(best), best.length, best, 2 * ITERATIONS)
    if every is None or not float((best.score.losses - every.score.losses).sum()) > 0:
        return found
    return search.better(found, search.settled(likeliest(every, 2 * ITERATIONS), swapped=True))


def _anew(search: Search) -> Trial | None:
    """A model fitted from the shortest segments on, with functions that join one by one or all at once.

    All functions but those of the mass at once are tried unless terms alone follow whole trajectories or the first
    model is at the noise.
    """
    if (fitter := _fitter(search, Variant(search.order))) is None:
        return None
    found = search.climbed(fitter, fitter.simple, {})
    if found is None or not (found.whole and (found.at_the_noise or not found.taken & set(fitter.functions))):
        taken = [*fitter.simple, *(name for name in fitter.functions if not name.startswith("mass"))]
        found = search.better(found, search.climbed(fitter, taken, {}, joining=False))
    return found
