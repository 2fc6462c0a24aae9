"""What a model of these coordinates may still be given: every number of the dictionary, alone or with its shape."""

from __future__ import annotations

import re
from typing import NamedTuple

import torch

from herglotz.models import ContactLagrangian
from herglotz.training.named_terms import own_terms
from herglotz.training.parameter_vector import ParameterVector

ALWAYS = ("kinetic.log_diagonal", "kinetic.base.log_diagonal", "damping.rate")
# Amplitudes with the numbers that shape them, which have no effect where the amplitude is 0.
SHAPES = {"friction.coulomb": "friction.log_smooth", "friction.breakaway": "friction.log_stribeck"}
SIMPLE = ("potential.stiffness", "potential.tilt", "friction.input_map")  # of the simplest model, beside `ALWAYS`


class Offer(NamedTuple):
    """Numbers that join a model together, by name; the first is 0 where it is not taken."""

    name: str
    numbers: tuple[str, ...]


def offers_of(model: ContactLagrangian, keys: list[str]) -> tuple[tuple[str, ...], list[Offer], frozenset[str]]:
    """The numbers that every model has, all offers, and the names of those that the simplest one has taken.

    `keys` (`training.dictionary.keys_of`) are what the numbers are.
    """
    numbers, always, found, simple = ParameterVector(model).numbers, [], [], set()
    own = own_terms(model.config.angles)  # of one coordinate: its spring and tilt
    for number, key in zip(numbers, keys, strict=True):
        stem = re.sub(r"\[\d+\]", "", number)
        if stem in ALWAYS:
            always.append(number)
        elif stem not in SHAPES.values() and not (stem == "friction.viscous" and model.dof == 1):  # that is the rate
            shape = number.replace(stem, SHAPES.get(stem, stem))
            found.append(Offer(key, (number, shape) if shape != number and shape in numbers else (number,)))
            if stem in SIMPLE or key in own:
                simple.add(key)
    return tuple(always), found, frozenset(simple)


def without_offers(model: ContactLagrangian, offers: list[Offer]) -> None:
    """Set the amplitudes of all offers to 0."""
    every = dict(zip(ParameterVector(model).numbers, ParameterVector(model).entries, strict=True))
    with torch.no_grad():
        for offer in offers:
            parameter, i = every[offer.numbers[0]]
            model.get_parameter(parameter).view(-1)[i] = 0.0
