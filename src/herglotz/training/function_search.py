"""Functions beside named terms, where these miss the data."""

from __future__ import annotations

from dataclasses import replace

from herglotz.progress import MORE_TERMS, inside, part
from herglotz.training.functions import bands
from herglotz.training.kernel import MAX_PARAMETERS
from herglotz.training.search import Search
from herglotz.training.strengths import likeliest, of_terms
from herglotz.training.trials import ITERATIONS, Fitter, Trial, Variant


@inside()
def with_functions(search: Search, best: Trial) -> Trial:
    """The model with functions, where it is better; `best` where it is not.

    Functions join a model that follows whole trajectories as all offers do: near the data its linear motion says which
    are worth a fit. Far from them a model of functions is made anew, from the shortest segments on.
    """
    if best.at_the_noise or search.config.translations:
        return best
    part(MORE_TERMS)
    found = _joined(search, best) if best.near else None
    found = _anew(search) if found is None else found
    if found is None or (best.near and not found.taken & set(found.fitter.functions)):
        return best
    return search.braking(search.finalist(search.better(best, found) or best, (best, found)))


def _fitter(search: Search, variant: Variant) -> Fitter | None:
    """The fitter of a variant with all functions; None where no kernel holds them."""
    fitter = search.fitter(replace(variant, functions=tuple(bands(search.over, search.base))))
    return fitter if len(fitter.start) <= MAX_PARAMETERS else None


def _joined(search: Search, best: Trial) -> Trial | None:
    """A model with the functions that join it one by one or, where that does not end at the noise, all at once.

    The model with all functions is worth further fits if it misses held-out blocks by less than the one without.
    None where the model cannot be fitted together with what all functions have. Terms that are waves of a function
    bring that function with them.
    """
    if (fitter := _fitter(search, replace(best.fitter.variant, kept=best.taken))) is None:
        return None
    taken = best.taken & {offer.name for offer in (*fitter.offers, *fitter.loads)}
    taken |= {own.name for own in fitter.variant.functions if best.taken & set(own.texts)}
    same = fitter.fit(taken, fitter.values_of(best), best.length, best)
    found = same and search.settled(search.finer(same), swapped=True)
    if found is None or found.at_the_noise:
        return found
    every = fitter.fit({*taken, *fitter.functions}, fitter.values_of(best), best.length, best, 2 * ITERATIONS)
    if every is None or not float((best.score.losses - every.score.losses).sum()) > 0:
        return found
    return search.better(found, search.settled(likeliest(every, 2 * ITERATIONS), swapped=True))


def _anew(search: Search) -> Trial | None:
    """A model of functions that join one by one or, where some do, all at once, without masses and with them."""
    if (fitter := _fitter(search, Variant(search.order))) is None:
        return None
    every, found = frozenset({*fitter.simple, *fitter.functions}), search.climbed(fitter, fitter.simple, {})
    for taken in dict.fromkeys((frozenset(x for x in every if not x.startswith("mass")), every)):
        if found is None or not (found.whole and (found.at_the_noise or not found.taken & set(fitter.functions))):
            found = search.better(found, search.climbed(fitter, taken, {}, joining=False))
    if found is None or found.taken & set(fitter.functions):
        return found
    return of_terms(found, search.fitter(replace(found.fitter.variant, functions=())), 2 * ITERATIONS)
