"""Functions of the coordinates that no named term says, as sums of waves with a Gaussian prior.

A Gaussian process on an interval is a sum of the waves that vanish at its ends, each with a coefficient of its own
(Solin & Särkkä 2020, Hilbert-space methods for reduced-rank Gaussian process regression): smooth functions need the
longest waves alone. The interval is `REACH` times as long as what was recorded, so that its ends lie outside. On an
angle they are whole waves, which are periodic. They join a model in bands, the longest waves first: the search takes as
many as held-out time asks for, and every wave is a named term, which is stepped, printed and exported like any other.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, combinations_with_replacement
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.models.features import parse
from herglotz.training.baseline import Baseline
from herglotz.training.dictionary import WAVES
from herglotz.training.named_terms import NamedTerms, own_terms

REACH = 1.5  # times the recorded interval
POTENTIAL = (8, 16, 32, 48)  # the waves that bands of a potential end with; of several lengths the first two
MASS = (4, 8)  # of the mass of one coordinate
DAMPING = (2, 4)  # of damping: pairs of cos and sin


class Band(NamedTuple):
    """Waves that join a model together."""

    function: str  # V(q1), damping(q1), mass(q1)
    name: str  # the same with the numbers of the waves
    texts: tuple[str, ...]
    rates: tuple[float, ...]  # of each wave, per unit of its coordinate
    longest: float  # that of the longest wave of the function


def bands(data: Trajectories) -> list[Band]:
    """All functions that these coordinates may be given beside their named terms."""
    found: list[Band] = []
    several = data.dof > 1
    for i, angle in enumerate(data.angles):
        own = _harmonics(i) if angle else _waves(data, [(i, 1.0)], POTENTIAL[-1])
        named = (1 if several else WAVES) if angle else 0  # its first waves are named terms
        ends = (named + POTENTIAL[0], POTENTIAL[1]) if angle else POTENTIAL[: 2 if several else None]
        found += _split(f"V(q{i + 1})", own, ends, 2 if angle else 1, named)
        around = own if angle else _pairs(data, i)
        found += _split(f"damping(q{i + 1})", [(f"{x} v{i + 1}", k) for x, k in around], DAMPING, 2)
        if not several:
            found += _split("mass(q1)", [(f"{x} v1^2", k) for x, k in own], MASS, 2 if angle else 1)
        elif angle:
            for a, b in combinations_with_replacement(range(1, data.dof + 1), 2):
                moving = [(f"{x} v{a} v{b}", k) for x, k in own]
                found += _split(f"mass(q{i + 1}) of v{a} v{b}", moving, (2,), 2, 1)
    for i, j in combinations(range(data.dof), 2):
        if data.angles[i] or data.angles[j]:
            continue
        between = _waves(data, [(j, 1.0), (i, -1.0)], POTENTIAL[1])
        found += _split(f"V(q{j + 1} - q{i + 1})", between, POTENTIAL[:2], 1)
    return found


def terms_with(every: Sequence[Band], terms: NamedTerms, angles: tuple[bool, ...]) -> NamedTerms:
    """The terms with all waves of these bands, which take the place of powers in the potential but the lowest."""
    own = own_terms(angles)
    kept = [
        text for text in terms.features
        if "v" in text or text in own or parse(text, angles)[0].function in ("cos", "sin")
    ]  # fmt: skip
    texts = [text for band in every for text in band.texts]
    drag = tuple(text for band in every if band.function.startswith("damping") for text in band.texts)
    still = NamedTerms(tuple(text for text in texts if text not in drag), drag)
    return replace(terms, features=tuple(kept)).joined(still)


def prior_spreads(every: Sequence[Band], base: Baseline, balance: Tensor, powers: list[str]) -> dict[str, float]:
    """Prior deviations, by what a number is: forces, masses and rates of the motion's own size, and continuous.

    Deviations fall with the number of the wave: of a potential that is a Matérn process of ν = 3/2. The lowest
    `powers`, whose place waves could take, are known to the same size.
    """
    found: dict[str, float] = {}
    force = max(v * v / x for v, x in zip(base.speed, base.scale, strict=True))
    rate = max(v / x for v, x in zip(base.speed, base.scale, strict=True))
    for key in powers:
        stem, _, at = key.partition("[")
        scale = base.scale[int(at.rstrip("]") or 0)]
        found[key] = force * {"potential.stiffness": 1 / scale, "q1^2": 0.5 / scale}.get(stem, 1.0)
    for band in every:
        for text, k in zip(band.texts, band.rates, strict=True):
            speeds = [int(x) - 1 for x in re.findall(r"v(\d+)", text)]
            mass = float((balance[0] / balance[speeds]).prod()) if len(speeds) == 2 else 1.0
            size = {"V": force / k, "mass": mass, "damping": rate}[band.function.split("(")[0]]
            found[text] = size * band.longest / k
    return found


def _split(
    name: str, waves: list[tuple[str, float]], ends: tuple[int, ...], each: int, first: int = 0
) -> Iterator[Band]:
    """Waves, `each` of one number, in bands that end with these numbers; the `first` numbers are left out."""
    longest = min(k for _, k in waves[first * each :])
    for end in ends:
        part = waves[first * each : end * each]
        if part:
            texts, rates = zip(*part, strict=True)
            yield Band(name, f"{name}, waves {first + 1}-{end}", texts, rates, longest)
        first = end


def _interval(data: Trajectories, form: list[tuple[int, float]]) -> tuple[float, float]:
    """Middle and half length of the interval of a linear form."""
    x = torch.stack([w * data.q[:, i] for i, w in form]).sum(0)
    low, high = float(x.min()), float(x.max())
    return (low + high) / 2, REACH * (high - low) / 2


def _waves(data: Trajectories, form: list[tuple[int, float]], count: int) -> list[tuple[str, float]]:
    """sin(k (x − a)) of a linear form x that vanish at both ends of its interval, which begins at a."""
    middle, half = _interval(data, form)
    longest, found = _short(math.pi / (2 * half)), []
    phase = _short(longest * (half - middle))
    for j in range(1, count + 1):
        parts = [(w * j * longest, f" q{i + 1}") for i, w in form] + [(j * phase, "")]
        text = " ".join(f"{'-' if w < 0 else '+'} {abs(w):.10g}{what}" for w, what in parts)
        found.append((f"sin({text.removeprefix('+ ')})", j * longest))
    return found


def _pairs(data: Trajectories, i: int) -> list[tuple[str, float]]:
    """Waves of one coordinate whose period is its interval."""
    half = _interval(data, [(i, 1.0)])[1]
    rates = [j * _short(math.pi / half) for j in range(1, DAMPING[-1] + 1)]
    return [(f"{f}({k:.10g} q{i + 1})", k) for k in rates for f in ("cos", "sin")]


def _short(x: float) -> float:
    """A number of seven digits, whose multiples are exact in ten: sines of multiples follow from that of one."""
    return float(f"{x:.7g}")


def _harmonics(i: int) -> list[tuple[str, float]]:
    """Waves of whole multiples of an angle."""
    every = range(1, POTENTIAL[1] + 1)
    return [(f"{f}({'' if k == 1 else k}q{i + 1})", float(k)) for k in every for f in ("cos", "sin")]
