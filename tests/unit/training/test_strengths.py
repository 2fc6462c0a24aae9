"""The strength of functions: which fits are asked for, and which stay."""

from types import SimpleNamespace
from typing import Any

import torch

from herglotz.training.trials import likeliest


class Fits:
    """A fitter whose fits miss held-out blocks by given losses, and the sets that were asked for."""

    def __init__(self, losses=()):
        self.losses, self.asked = list(losses), []

    def fit(self, taken, values, length, before, most):  # noqa: ARG002
        self.asked.append((set(before.taken - taken), most))
        loss = self.losses.pop(0) if self.losses else before.score.losses.sum().item()
        return None if loss is None else trial(self, taken, loss)


def trial(fits, taken, loss=0.0) -> Any:
    scales = {name: size for name, size in (("a", 1.0), ("b", 0.1), ("c", 0.5)) if name in taken}
    return SimpleNamespace(
        fitter=fits, taken=frozenset(taken), values={}, length=5, likeliest_scales=scales,
        score=SimpleNamespace(losses=torch.tensor([loss]), price_of_a_number=0.97),
    )  # fmt: skip


def test_strengths_follow_the_fit_as_long_as_held_out_blocks_are_missed_by_less():
    # fails if one fit is made, a worse one is taken, or a fit without a path ends the search
    fits = Fits([3.0, 2.0, 2.5])
    found = likeliest(trial(fits, "abc", 4.0), 7)
    assert found.score.losses.tolist() == [2.0]
    assert fits.asked == [(set(), 7)] * 3
    first = trial(Fits([None]), "abc", 4.0)
    assert likeliest(first, 7) is first
    # what gains less than a number costs is the last one
    fits = Fits([3.5, 3.0])
    assert likeliest(trial(fits, "abc", 4.0), 7).score.losses.tolist() == [3.5]
    assert fits.losses == [3.0]


def test_a_model_without_functions_is_not_fitted_again():
    # fails if a search of named terms alone makes more fits than before
    fits = Fits([1.0])
    first = trial(fits, "xy", 4.0)
    assert likeliest(first, 7) is first
    assert fits.asked == []
