"""The dissipation of a model that a search has found.

No dry friction injects energy, dry friction can hold a joint still, and damping may depend on s.

`search` is a `herglotz.training.search.Search`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from herglotz.models.config import POWERS
from herglotz.progress import MORE_TERMS, inside, part
from herglotz.training.named_terms import DRY
from herglotz.training.offers import standing
from herglotz.training.task import LEAST_GRIP
from herglotz.training.trials import ITERATIONS, Trial, Variant

# Amplitude of Stribeck friction: the excess of breakaway over Coulomb friction.
EXCESS = "friction.breakaway"


def without_injecting_friction(search: Any, trial: Trial) -> Trial:
    """The model settled anew without dry friction that injects energy, with a load of the joint in its place."""
    other = _with_loads(trial)
    return trial if other is trial else _with_loads(search.settled(other))


def _with_loads(trial: Trial) -> Trial:
    """The model with a load, if offered, in the place of each dry friction that injects energy, fitted."""
    while injecting := trial.injecting_friction:
        every = {offer.name for offer in (*trial.fitter.offers, *trial.fitter.loads)}
        loads = every & {f"load {i + 1}" for i in injecting.values()}
        taken = standing(trial.fitter.offers, trial.taken - set(injecting)) | loads
        other = trial.fitter.fit(taken, trial.values, trial.length, trial, 2 * ITERATIONS)
        if other is None:
            break
        trial = other
    return trial


def with_sticking(search: Any, trial: Trial) -> Trial:
    """The model with dry friction that can hold a joint still, unless the smooth model is better."""
    if search.config.sticking is False or not any(name.startswith(DRY) for name in trial.taken):
        return trial
    fitter = search.fitter(replace(trial.fitter.variant, sticking=True))
    # A breakaway force of 0 or less is no friction and has no slope, from which a fit could not return.
    lowest = LEAST_GRIP * max(search.base.speed)
    breakaway = {DRY: lowest, EXCESS: lowest / 100}
    values = {
        name: max(x, breakaway.get(name.split("[")[0], -math.inf)) if x != 0 else x for name, x in trial.values.items()
    }
    sticking = fitter.fit(trial.taken, values, trial.length, trial, 2 * ITERATIONS)
    # A step in which the joint stops is less accurate than the steps of the smooth model.
    sticking = sticking and search.finer(sticking)
    return trial if sticking is None or trial.replaces(sticking) else search.settled(sticking)


@inside()
def with_dissipation(search: Any, found: Trial, best: Trial) -> Trial:
    """A model whose damping depends on s if held-out time asks for it, otherwise `found`.

    A search is worth its time where s² makes a better model of `best`, the best model by the score, or where `best`
    follows nothing for long. The second search starts with s²: where s and its coefficient are 0, the motion changes
    with neither.
    """
    if found.at_the_noise or search.config.translations or search.config.sticking:
        return found
    part(MORE_TERMS)
    variant = Variant(2, dissipation=tuple(POWERS), windings=best.fitter.variant.windings)
    fitter, lowest = search.fitter(variant), next(iter(POWERS))
    asked = fitter.fit(best.taken | {lowest}, best.values, best.length, best, 2 * ITERATIONS)
    if best.whole and (asked is None or not asked.replaces(best)):
        return found
    for taken in (fitter.simple, fitter.simple | {lowest}):
        if (other := search.climbed(fitter, taken, {})) is not None:
            found = search.better(found, other) or found
            if other.at_the_noise:
                break
    return found
