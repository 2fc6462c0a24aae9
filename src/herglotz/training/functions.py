"""Learned functions of coordinates and speeds: sums of waves with a Gaussian prior, beside the named terms.

A Gaussian process on an interval is a sum of the sine waves that vanish at both ends, with independent coefficients
(Solin & Särkkä 2020, Hilbert-space methods for reduced-rank Gaussian process regression); a smooth function needs only
the longest waves. The interval is `REACH` times the recorded range, so that both ends lie outside the data. Functions
of an angle are sums of the harmonics of the angle. Functions of a speed, and of two coordinates, are sums of cos and
sin whose period is the interval.

The prior keeps a function at 0 where the data say nothing, so all waves can join a model together. The waves of an
octave are a band with a prior variance of its own. A wave is a named term: stepping, printing and export need no code
for waves.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.models.drag import parse_drag
from herglotz.models.features import parse
from herglotz.training.baseline import Baseline
from herglotz.training.named_terms import NamedTerms, own_terms
from herglotz.training.waves import BRAKES, Form, Wave, waves_of

# Interval of the waves over the recorded range.
REACH = 1.5

# The first harmonic of an angle, which is a named term.
FIRST_HARMONIC = re.compile(r"(cos|sin)\(q\d+\)")


class Band(NamedTuple):
    """Waves of a function that join a model together, with one prior variance.

    `name` reads V(q1) 1, damping(q1) 1, mass(q1) 2 or friction(v1) 1, for example. `rates` are the angular rates k of
    the waves, per unit of the coordinate; `longest` is the rate of the longest wave of the whole function.
    """

    name: str
    texts: tuple[str, ...]
    rates: tuple[float, ...]
    longest: float

    @property
    def brakes(self) -> bool:
        """True if the function is a dissipative force, which is no part of L."""
        return self.name.startswith(BRAKES)


def bands(data: Trajectories, base: Baseline, *, fine: bool = False) -> list[Band]:
    """The bands of all functions that a model of these coordinates may have beside the named terms.

    `fine`: the damping and the mass of the only coordinate have waves as short as those of the potential, which would
    be too many for a search.
    """
    found = waves_of(
        data.angles, lambda form: _interval(data, form), [REACH * v for v in base.speed], fine=fine,
        plane=len(set(data.units)) == 1,
    )  # fmt: skip
    return [band for name, waves in found.items() for band in _octaves(name, waves)]


def terms_with(
    every: Sequence[Band], terms: NamedTerms, angles: tuple[bool, ...], kept: Collection[str] = ()
) -> NamedTerms:
    """The terms joined by all waves of the bands, without the powers in the potential that waves can replace.

    Terms in `kept` stay.
    """
    gone = replaced(terms.features, (), angles).difference(kept)
    left = [text for text in terms.features if text not in gone]
    waves = {brakes: [text for own in every if own.brakes == brakes for text in own.texts] for brakes in (False, True)}
    return replace(terms, features=tuple(left)).joined(NamedTerms(tuple(waves[False]), tuple(waves[True])))


def replaced(features: Iterable[str], drag: Iterable[str], angles: tuple[bool, ...]) -> set[str]:
    """The terms that functions can replace: powers in the potential, and drag that depends on one coordinate alone."""
    own = own_terms(angles)
    powers = {
        text for text in features
        if "v" not in text and text not in own and parse(text, angles)[0].function not in ("cos", "sin")
    }  # fmt: skip
    parsed = {text: parse_drag(text, angles) for text in drag}
    alone = {x for x, f in parsed.items() if f.of is None and f.at == f.on and (f.b or f.c) and not (f.air or f.wave)}
    return powers | alone


def prior_spreads(every: Sequence[Band], base: Baseline, balance: Tensor, powers: list[str]) -> dict[str, float]:
    """Prior standard deviations of the coefficients of waves and of the lowest `powers`, by key.

    The longest wave of a force or a damping has the size that the motion itself has, and the longest wave of a mass
    half the mass. The deviations fall with the rate k of a wave as those of a Matérn process with ν = 3/2: as k^−2 on
    a line and k^−2.5 in the plane. With a rougher or larger mass, fits of short segments find a mass that is negative
    somewhere. Powers, which a sum of waves can imitate, have the size of the same force.
    """
    found: dict[str, float] = {}
    force = max(v * v / x for v, x in zip(base.speed, base.scale, strict=True))
    rate = max(v / x for v, x in zip(base.speed, base.scale, strict=True))
    for key in powers:
        stem, _, at = key.partition("[")
        scale = base.scale[int(at.rstrip("]") or 0)]
        found[key] = force * {"potential.stiffness": 1 / scale, "q1^2": 0.5 / scale}.get(stem, 1.0)
    for own in every:
        for text, k in zip(own.texts, own.rates, strict=True):
            speeds = [int(x) - 1 for x in re.findall(r"v(\d+)", text)]
            mass = float((balance[0] / balance[speeds]).prod()) if len(speeds) == 2 else 1.0
            sizes = {"V": force / own.longest, "mass": mass / 2, "damping": rate, "friction": force}
            found[text] = sizes[own.name.split("(")[0]] * (own.longest / k) ** (2.5 if "," in own.name else 2.0)
    return found


def _octaves(name: str, waves: list[Wave]) -> Iterator[Band]:
    """The waves of a function in bands, one for each octave of the rate, the first two octaves together.

    The first harmonic of an angle is left out, because it is a named term.
    """
    longest = min(k for _, k in waves)
    rest = [(text, k) for text, k in waves if not FIRST_HARMONIC.fullmatch(text)]
    octave = lambda wave: max(2, math.floor(round(wave[1] / longest, 6)).bit_length())  # noqa: E731
    for number, (_, part) in enumerate(groupby(rest, octave), 1):
        texts, rates = zip(*part, strict=True)
        yield Band(f"{name} {number}", texts, rates, longest)


def _interval(data: Trajectories, form: Form) -> tuple[float, float]:
    """Middle and half length of the interval of a linear form."""
    x = torch.stack([w * data.q[:, i] for i, w in form]).sum(0)
    low, high = float(x.min()), float(x.max())
    return (low + high) / 2, REACH * (high - low) / 2
