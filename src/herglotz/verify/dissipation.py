"""Null models of dissipation: a run must follow its data better than with γ → −γ, 0, γ/2 and 2γ.

A run without dissipation is compared with the rate, of either sign, that minimises the error of the windows.

Weak damping changes twenty steps by a few per cent of the spread, less than the bound of "follows the data". The same
windows with altered dissipation show whether the data determine the rate, and whether the model's rate is right.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import torch

from herglotz.models import ContactLagrangian
from herglotz.training import Run
from herglotz.verify.report import Check

# Recorded steps of a window: long enough for the error of one step to grow, too short for chaos.
WINDOW = 20
# Factors of the rate in the null models.
FACTORS = (-1.0, 0.0, 0.5, 2.0)
# Trial rates times the duration of a window. Such rates change the motion by a hundredth, which is linear in the rate.
TRIAL_DECAY = 0.01
# A model of rate 0 fails if a rate divides its error by more. Missing damping in exact data gives 7 to 1e3, the error
# of the integration rule 2.3.
MAX_ERROR_RATIO_WITHOUT_RATE = 5.0
# The dissipation is judged if a null model changes the error by more than this share.
MIN_RELATIVE_CHANGE = 0.05


def dissipation(run: Run, error: Callable[[Run], float], own: float) -> tuple[Check | None, str]:
    """Compare the error of the run's windows with those of its null models; None and a note if the data decide nothing.

    `error` gives the RMS of free runs over windows for any run on these data; `own` is the RMS of this run.
    """
    rates = _rates(run.model)
    if not math.isfinite(own) or not rates:
        return None, ""
    if not any(bool((x != 0).any()) for x in rates):
        return _undamped(run, error, own), ""
    nulls = {factor: error(replace(run, model=_scaled(run.model, factor))) for factor in FACTORS}
    best = min(nulls.values())
    if not abs(best - own) > MIN_RELATIVE_CHANGE * own:
        return None, "; dissipation is not judged: γ → −γ, 0, γ/2 or 2γ changes nothing that the data show"
    listed = ", ".join(f"{x:g}γ {value:.2g}" for x, value in nulls.items())
    claim = "dissipation: better than −γ, 0, γ/2, 2γ (ratio)"
    ratio = own / best if best > 0 else math.inf
    return Check("dissipation", claim, ratio, 1.0, ratio < 1, f"over spread: γ {own:.2g}, {listed}", "<"), ""


def _undamped(run: Run, error: Callable[[Run], float], own: float) -> Check | None:
    """Compare a model of rate 0 with the best rate, the minimum of the squared error as a parabola of the rate."""
    small = TRIAL_DECAY / (WINDOW * run.h)
    up, down = (error(replace(run, model=_scaled(run.model, 0.0, rate))) ** 2 for rate in (small, -small))
    bend = up + down - 2 * own**2
    if not (math.isfinite(bend) and bend > 0):
        return None
    rate = small * (down - up) / (2 * bend)
    best = error(replace(run, model=_scaled(run.model, 0.0, rate)))
    claim, ratio = "no dissipation: no rate follows better by 5 (ratio)", own / best if best > 0 else math.inf
    note = f"over spread: γ = 0 {own:.2g}, γ = {rate:.3g} {best:.2g}"
    bound = MAX_ERROR_RATIO_WITHOUT_RATE
    return Check("dissipation", claim, ratio, bound, ratio < bound, note, "<")


def _rates(model: ContactLagrangian) -> list[torch.Tensor]:
    """The dissipative parameters: the rate of the contact form, and viscous friction."""
    found = [getattr(model.damping, "rate", None), getattr(model.friction, "viscous", None)]
    return [x for x in found if x is not None]


def _scaled(model: ContactLagrangian, factor: float, more: float = 0.0) -> ContactLagrangian:
    """A copy of the model with its rates times a factor, and `more` added to the first rate."""
    model = deepcopy(model)
    with torch.no_grad():
        for rate in _rates(model):
            rate.mul_(factor)
        _rates(model)[0].add_(more)
    return model
