"""Null models of dissipation: a fit must follow its data better than with γ → −γ, 0, γ/2 and 2γ.

A fit without dissipation is compared with the rate, of either sign, at which the windows' error is least.

Weak damping changes twenty steps by a few per cent of the spread, which the bound of "follows the data" lets pass. The
same windows with the dissipation altered say whether the data know it, and whether the model has it right.
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

WINDOW = 20  # recorded steps: errors of one step have grown, chaos has not
FACTORS = (-1.0, 0.0, 0.5, 2.0)  # the wrong sign, none, half and twice
TRIED = 0.01  # of a window: rates so small change its motion by a hundredth, in proportion
# An error that a rate divides by more is one of dissipation: exact data give 7 to 1e3, the rule's own error 2.3.
LESS = 5.0
TOLD = 0.05  # the data tell the dissipation where an altered one changes the error by more than this share


def dissipation(run: Run, error: Callable[[Run], float], own: float) -> tuple[Check | None, str]:
    """Compare the error of the run's windows with those of its null models; None and a note where nothing is told.

    `error` is the RMS of free runs over windows, of any run on these data, and `own` that of this run.
    """
    rates = _rates(run.model)
    if not math.isfinite(own) or not rates:
        return None, ""
    if not any(bool((x != 0).any()) for x in rates):
        return _undamped(run, error, own), ""
    nulls = {factor: error(replace(run, model=_scaled(run.model, factor))) for factor in FACTORS}
    best = min(nulls.values())
    if not abs(best - own) > TOLD * own:
        return None, "; dissipation is not judged: γ → −γ, 0, γ/2 or 2γ changes nothing that the data show"
    listed = ", ".join(f"{x:g}γ {value:.2g}" for x, value in nulls.items())
    claim = "dissipation: better than −γ, 0, γ/2, 2γ (ratio)"
    ratio = own / best if best > 0 else math.inf
    return Check("dissipation", claim, ratio, 1.0, ratio < 1, f"over spread: γ {own:.2g}, {listed}", "<"), ""


def _undamped(run: Run, error: Callable[[Run], float], own: float) -> Check | None:
    """Compare a model of rate 0 with the best rate, where the squared error as a parabola of the rate is least."""
    small = TRIED / (WINDOW * run.h)
    up, down = (error(replace(run, model=_scaled(run.model, 0.0, rate))) ** 2 for rate in (small, -small))
    bend = up + down - 2 * own**2
    if not (math.isfinite(bend) and bend > 0):
        return None
    rate = small * (down - up) / (2 * bend)
    best = error(replace(run, model=_scaled(run.model, 0.0, rate)))
    claim, ratio = "no dissipation: no rate follows better by 5 (ratio)", own / best if best > 0 else math.inf
    note = f"over spread: γ = 0 {own:.2g}, γ = {rate:.3g} {best:.2g}"
    return Check("dissipation", claim, ratio, LESS, ratio < LESS, note, "<")


def _rates(model: ContactLagrangian) -> list[torch.Tensor]:
    """The parameters that dissipate: the rate of the contact form, and viscous friction."""
    found = [getattr(model.damping, "rate", None), getattr(model.friction, "viscous", None)]
    return [x for x in found if x is not None]


def _scaled(model: ContactLagrangian, factor: float, more: float = 0.0) -> ContactLagrangian:
    model = deepcopy(model)
    with torch.no_grad():
        for rate in _rates(model):
            rate.mul_(factor)
        _rates(model)[0].add_(more)
    return model
