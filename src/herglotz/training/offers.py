"""Offers of a search: the parameters of the dictionary that a model may be given, alone or with their shapes."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import torch

from herglotz.models import ContactLagrangian
from herglotz.training.dictionary import WEIGHTS
from herglotz.training.functions import Band
from herglotz.training.named_terms import own_terms
from herglotz.training.parameter_vector import ParameterVector

# Parameters of every model.
ALWAYS = ("kinetic.log_diagonal", "kinetic.base.log_diagonal", "damping.rate")
# Amplitudes with their shape parameters, which have no effect while the amplitude is 0.
SHAPES = {"friction.coulomb": "friction.log_smooth", "friction.breakaway": "friction.log_stribeck"}
# Breakaway is the excess over Coulomb friction, and means nothing without Coulomb friction.
EXCESS_OF = {"friction.breakaway": "friction.coulomb"}
# Gains of all inputs, row by row.
INPUTS = "friction.input_map"
# Zeros of all inputs.
ZEROS = "friction.input_zero"
# Constant forces at rest, for which a zero of the sensor can stand.
TILT = "potential.tilt"
# Parameters of the simplest model, beside `ALWAYS`.
SIMPLE = ("potential.stiffness", TILT, INPUTS)


class Offer(NamedTuple):
    """Parameters that join a model together.

    `amplitudes` are 0 in a model without the offer, and `shapes` then have no effect. `on` names the offer that this
    offer depends on, or is empty.
    """

    name: str
    amplitudes: tuple[str, ...]
    shapes: tuple[str, ...] = ()
    on: str = ""

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of all parameters of the offer."""
        return self.amplitudes + self.shapes


def offers_of(
    model: ContactLagrangian, keys: list[str], bands: Sequence[Band] = (), terms: int = 0
) -> tuple[tuple[str, ...], list[Offer], frozenset[str]]:
    """The parameters of every model, all offers, and the names of the offers in the simplest model.

    `keys` (`training.dictionary.keys_of`) name the parameters by their terms. Coefficients of waves join by `bands`.
    The last `terms` inputs are functions of recorded inputs; the simplest model does not have their gains.
    """
    numbers, always, found, simple = ParameterVector(model).numbers, [], [], set()
    waves = {text for band in bands for text in band.texts}
    m, n = model.inputs, model.dof
    of_terms = {f"{INPUTS}[{i * m + j}]" for i in range(n) for j in range(m - terms, m)}
    springs = own_terms(model.config.angles)
    # Viscous friction of a single coordinate is the damping rate, which every model has.
    no_offers = {*SHAPES.values(), *(["friction.viscous"] if n == 1 else [])}
    for number, key in zip(numbers, keys, strict=True):
        if key in waves:
            continue
        stem = re.sub(r"\[\d+\]", "", number)
        # Beyond the recorded range waves vanish, and springs and tilts bound the motion.
        if stem in ALWAYS or (bands and (stem in SIMPLE[:2] or key in springs)):
            always.append(number)
        elif stem not in no_offers:
            found.append(_offer(number, key, stem, numbers))
            if (stem in SIMPLE and number not in of_terms) or key in springs or (key == WEIGHTS[0] and not bands):
                simple.add(key)
    place = dict(zip(keys, numbers, strict=True))
    found += [Offer(band.name, tuple(place[text] for text in band.texts)) for band in bands]
    return tuple(always), found, frozenset(simple)


def _offer(number: str, key: str, stem: str, numbers: Collection[str]) -> Offer:
    """The offer of one amplitude, with its shape parameter if the model has one; `stem` is `number` without indices."""
    shape = number.replace(stem, SHAPES.get(stem, stem))
    on = key.replace(stem, EXCESS_OF[stem]) if stem in EXCESS_OF else ""
    return Offer(key, (number,), (shape,) if shape != number and shape in numbers else (), on)


def standing(offers: Iterable[Offer], taken: Collection[str]) -> frozenset[str]:
    """The offers in `taken` whose own `Offer.on`, if any, is in `taken` too."""
    on = {offer.name: offer.on for offer in offers}
    return frozenset(name for name in taken if not on.get(name) or on[name] in taken)


def without_offers(model: ContactLagrangian, offers: list[Offer]) -> None:
    """Set the amplitudes of these offers to 0 in the model, in place."""
    vector = ParameterVector(model)
    entries = dict(zip(vector.numbers, vector.entries, strict=True))
    with torch.no_grad():
        for parameter, i in (entries[name] for offer in offers for name in offer.amplitudes):
            model.get_parameter(parameter).view(-1)[i] = 0.0
