"""Learned functions beside named terms, for data that named terms alone do not follow to the noise."""

from __future__ import annotations

from herglotz.progress import MORE_TERMS, inside, part
from herglotz.training.search import Search
from herglotz.training.trials import Trial


@inside()
def with_functions(search: Search, best: Trial) -> Trial:
    """A model with functions if that is better than `best`, otherwise `best`.

    The functions join one by one, from the shortest segments on, and all but those of the mass at once.
    """
    fitter = None if best.at_the_noise else search.function_fitter
    if fitter is None:
        return best
    part(MORE_TERMS)
    found = search.climbed(fitter, fitter.simple, {})
    if not (found and found.at_the_noise) and search.flexible is not None:
        found = search.better(found, search.pared(search.flexible))
    if found is None or not found.taken & set(found.fitter.functions):
        return best
    return search.better(best, found) or best
