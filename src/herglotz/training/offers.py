"""What a model of these coordinates may still be given: every number of the dictionary, alone or with its shape."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import torch

from herglotz.models import ContactLagrangian
from herglotz.training.functions import Band
from herglotz.training.named_terms import own_terms
from herglotz.training.parameter_vector import ParameterVector

ALWAYS = ("kinetic.log_diagonal", "kinetic.base.log_diagonal", "damping.rate")
# Amplitudes with the numbers that shape them, which have no effect where the amplitude is 0.
SHAPES = {"friction.coulomb": "friction.log_smooth", "friction.breakaway": "friction.log_stribeck"}
ON = {"friction.breakaway": "friction.coulomb"}  # what is an excess of another offer is none without it
INPUTS = "friction.input_map"  # gains of all inputs, row by row
ZEROS = "friction.input_zero"  # of all inputs
SIMPLE = ("potential.stiffness", "potential.tilt", INPUTS)  # of the simplest model, beside `ALWAYS`


class Offer(NamedTuple):
    """Numbers that join a model together, by name."""

    name: str
    amplitudes: tuple[str, ...]  # 0 where it is not taken
    shapes: tuple[str, ...] = ()  # what has no effect then
    on: str = ""  # the offer without which this one is none

    @property
    def numbers(self) -> tuple[str, ...]:
        """All of them."""
        return self.amplitudes + self.shapes


def offers_of(
    model: ContactLagrangian, keys: list[str], bands: Sequence[Band] = (), terms: int = 0
) -> tuple[tuple[str, ...], list[Offer], frozenset[str]]:
    """The numbers that every model has, all offers, and the names of those that the simplest one has taken.

    `keys` (`training.dictionary.keys_of`) are what the numbers are; those of waves join in their `bands`. The last
    inputs are `terms` of others, which the simplest model is without.
    """
    numbers, always, found, simple = ParameterVector(model).numbers, [], [], set()
    waves = {text for own in bands for text in own.texts}
    m, n = model.inputs, model.dof
    of_terms = {f"{INPUTS}[{i * m + j}]" for i in range(n) for j in range(m - terms, m)}
    own = own_terms(model.config.angles)  # of one coordinate: its spring and tilt
    for number, key in zip(numbers, keys, strict=True):
        stem = re.sub(r"\[\d+\]", "", number)
        if stem in ALWAYS:
            always.append(number)
        elif key in waves:
            continue
        elif bands and (stem in SIMPLE[:2] or key in own):  # what holds a motion beyond the data, where waves are 0
            always.append(number)
        elif stem not in SHAPES.values() and not (stem == "friction.viscous" and model.dof == 1):  # that is the rate
            shape = number.replace(stem, SHAPES.get(stem, stem))
            on = key.replace(stem, ON[stem]) if stem in ON else ""
            found.append(Offer(key, (number,), (shape,) if shape != number and shape in numbers else (), on))
            if (stem in SIMPLE and number not in of_terms) or key in own:
                simple.add(key)
    place = dict(zip(keys, numbers, strict=True))
    found += [Offer(own.name, tuple(place[text] for text in own.texts)) for own in bands]
    return tuple(always), found, frozenset(simple)


def standing(offers: Iterable[Offer], taken: Collection[str]) -> frozenset[str]:
    """What is left of these offers where some have lost the offer that they are of."""
    on = {offer.name: offer.on for offer in offers}
    return frozenset(name for name in taken if not on.get(name) or on[name] in taken)


def without_offers(model: ContactLagrangian, offers: list[Offer]) -> None:
    """Set the amplitudes of all offers to 0."""
    every = dict(zip(ParameterVector(model).numbers, ParameterVector(model).entries, strict=True))
    with torch.no_grad():
        for parameter, i in (every[name] for offer in offers for name in offer.amplitudes):
            model.get_parameter(parameter).view(-1)[i] = 0.0
