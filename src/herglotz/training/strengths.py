"""How strong functions are, and which bands of their waves a model needs."""

from __future__ import annotations

import math

from herglotz.training.trials import Fitter, Trial


def likeliest(trial: Trial, most: int) -> Trial:
    """The model with strengths of its bands that follow from its fit, as long as held-out blocks are missed by less.

    A fit takes `most` iterations. The last one gains less than a number costs. A model without functions has no
    strengths, and stays.
    """
    gain = math.inf
    while trial.sizes and gain > trial.score.of_a_number:
        other = trial.fitter.fit(trial.taken, trial.values, trial.length, trial, most)
        if other is None or not (gain := float((trial.score.losses - other.score.losses).sum())) > 0:
            break
        trial = other
    return trial


def needed(trial: Trial, most: int) -> Trial:
    """The model without the bands that are not worth their price, each tried once by a fit, the weakest first.

    `Moves` foretells what leaves by linear motion alone.
    """
    for name in sorted(trial.sizes, key=trial.sizes.__getitem__):
        other = trial.fitter.fit(trial.taken - {name}, trial.values, trial.length, trial, most)
        if other is not None and not trial.replaces(other):
            trial = likeliest(other, most)
    return trial


def of_terms(trial: Trial, plain: Fitter, most: int) -> Trial | None:
    """The model of a trial that has taken no function, fitted by the fitter of its terms alone."""
    powers = plain.simple - trial.fitter.simple  # no offers where functions are: every model has them there
    return plain.fit(trial.taken | powers, plain.values_of(trial), trial.length, trial, most)
