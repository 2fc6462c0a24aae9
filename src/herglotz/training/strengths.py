"""Prior variances of learned functions by evidence, and the bands of their waves that a model needs."""

from __future__ import annotations

import math

from herglotz.training.trials import Trial


def likeliest(trial: Trial, most: int) -> Trial:
    """The model refitted with the likeliest prior variances of its bands (`Trial.likeliest_scales`).

    Each refit has at most `most` iterations. Refits end when the held-out log-loss falls by less than the price of one
    parameter. A refit with a larger log-loss is dropped. A model without functions is returned as it is.
    """
    gain = math.inf
    while trial.likeliest_scales and gain > trial.score.price_of_a_number:
        other = trial.fitter.fit(trial.taken, trial.values, trial.length, trial, most)
        if other is None or not (gain := float((trial.score.losses - other.score.losses).sum())) > 0:
            break
        trial = other
    return trial


def needed(trial: Trial, most: int) -> Trial:
    """The model without the bands that are not worth their price; each removal is fitted, the weakest band first.

    `Moves.leaving` removes bands too, but by the linearised motion alone.
    """
    # The row law 1 noisy of `benchmarks/judge.py` needs this loop: 6.1 times the noise, and 61 without it.
    for name in sorted(trial.likeliest_scales, key=trial.likeliest_scales.__getitem__):
        other = trial.fitter.fit(trial.taken - {name}, trial.values, trial.length, trial, most)
        if other is not None and not trial.replaces(other):
            trial = likeliest(other, most)
    return trial
