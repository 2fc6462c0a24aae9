"""Functions of coordinates and speeds that no named term says, as sums of waves with a Gaussian prior.

A Gaussian process on an interval is a sum of the waves that vanish at its ends, each with a coefficient of its own
(Solin & Särkkä 2020, Hilbert-space methods for reduced-rank Gaussian process regression): smooth functions need the
longest waves alone. The interval is `REACH` times as long as what was recorded, so that its ends lie outside. On an
angle they are whole waves, which are periodic; of a speed, and in the plane, waves whose period is the interval. What
data do not tell of a function its prior holds at 0, so that all waves join a model together. Octaves of a function are
bands, each with a strength of its own. Every wave is a named term, which is stepped, printed and exported like any
other.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, combinations_with_replacement, groupby
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.models.drag import parse_drag
from herglotz.models.features import parse
from herglotz.training.baseline import Baseline
from herglotz.training.named_terms import NamedTerms, own_terms

REACH = 1.5  # times the recorded interval
POTENTIAL, OF_MANY = 47, 15  # waves of the potential of one length, of each of several lengths; harmonics of an angle
PLANE = 80  # of a potential of two lengths: pairs of cos and sin
MASS = 7  # of the mass of one coordinate
DAMPING = 3  # of damping by position: pairs of cos and sin
FRICTION = 7  # of friction by speed: pairs of cos and sin

OWN = re.compile(r"(cos|sin)\(q\d+\)")  # of an angle: what the baseline has


class Band(NamedTuple):
    """Waves of a function that join a model together, with one strength."""

    name: str  # V(q1) 1, damping(q1) 1, mass(q1) 2, friction(v1) 1
    texts: tuple[str, ...]
    rates: tuple[float, ...]  # of each wave, per unit of its coordinate
    longest: float  # rate of the longest wave of the function

    @property
    def brakes(self) -> bool:
        """Whether it is a force beside L."""
        return self.name.startswith(("damping", "friction"))


def bands(data: Trajectories, base: Baseline, *, fine: bool = False) -> list[Band]:
    """All functions that these coordinates may be given beside their named terms.

    `fine`: the damping and the mass of one coordinate have waves as short as its potential's, which are too many for a
    search.
    """
    found: dict[str, list[tuple[str, float]]] = {}
    several = data.dof > 1
    pairs, mass = (POTENTIAL // 2, POTENTIAL) if fine and not several else (DAMPING, MASS)
    for i, angle in enumerate(data.angles):
        own = _harmonics(i) if angle else _waves(data, [(i, 1.0)], OF_MANY if several else POTENTIAL)
        found[f"V(q{i + 1})"] = own
        around = own if angle else _pairs(data, i, pairs)
        found[f"damping(q{i + 1})"] = [(f"{x} v{i + 1}", k) for x, k in around[: 2 * pairs]]
        found[f"friction(v{i + 1})"] = _of_speed(f"v{i + 1}", base.speed[i])
        if not several:
            found["mass(q1)"] = [(f"{x} v1^2", k) for x, k in own[: 2 * mass if angle else mass]]
        elif angle:
            for a, b in combinations_with_replacement(range(1, data.dof + 1), 2):
                found[f"mass(q{i + 1}) of v{a} v{b}"] = [(f"{x} v{a} v{b}", k) for x, k in own[2:4]]
    for i, j in combinations(range(data.dof), 2):
        if data.angles[i] or data.angles[j]:
            continue
        found[f"V(q{j + 1} - q{i + 1})"] = _waves(data, [(j, 1.0), (i, -1.0)], OF_MANY)
        found[f"friction(v{j + 1} - v{i + 1})"] = _of_speed(f"(v{j + 1} - v{i + 1})", base.speed[i] + base.speed[j])
        if data.dof == 2 and data.units[i] == data.units[j]:
            found[f"V(q{i + 1}, q{j + 1})"] = _plane(data, i, j)
    return [band for name, waves in found.items() for band in _octaves(name, waves)]


def terms_with(
    every: Sequence[Band], terms: NamedTerms, angles: tuple[bool, ...], kept: Collection[str] = ()
) -> NamedTerms:
    """The terms with all waves of these functions, which take the place of powers in the potential but the lowest.

    Those that are `kept` stay.
    """
    gone = replaced(terms.features, (), angles).difference(kept)
    left = [text for text in terms.features if text not in gone]
    waves = {brakes: [text for own in every if own.brakes == brakes for text in own.texts] for brakes in (False, True)}
    still = NamedTerms(tuple(waves[False]), tuple(waves[True]))
    return replace(terms, features=tuple(left)).joined(still)


def replaced(features: Iterable[str], drag: Iterable[str], angles: tuple[bool, ...]) -> set[str]:
    """Those of these terms that functions can stand for: powers in the potential, and drag of one coordinate alone."""
    own = own_terms(angles)
    still = {
        text for text in features
        if "v" not in text and text not in own and parse(text, angles)[0].function not in ("cos", "sin")
    }  # fmt: skip
    parsed = {text: parse_drag(text, angles) for text in drag}
    alone = {x for x, f in parsed.items() if f.of is None and f.at == f.on and (f.b or f.c) and not (f.air or f.wave)}
    return still | alone


def prior_spreads(every: Sequence[Band], base: Baseline, balance: Tensor, powers: list[str]) -> dict[str, float]:
    """Prior deviations, by what a number is: forces and rates of the motion's own size, and half the mass.

    They fall with the rate k of the wave as those of a Matérn process of ν = 3/2 do, as k^−2 on a line and k^−2.5 in
    the plane. A mass that is rougher or larger is negative somewhere in a fit of short segments. The lowest `powers`,
    whose place waves could take, are known to the same size.
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


def _octaves(name: str, waves: list[tuple[str, float]]) -> Iterator[Band]:
    """The waves of a function in octaves of their rates, the first two together.

    An angle's own cos and sin are named terms.
    """
    longest = min(k for _, k in waves)
    rest = [(text, k) for text, k in waves if not OWN.fullmatch(text)]
    octave = lambda wave: max(2, math.floor(round(wave[1] / longest, 6)).bit_length())  # noqa: E731
    for number, (_, part) in enumerate(groupby(rest, octave), 1):
        texts, rates = zip(*part, strict=True)
        yield Band(f"{name} {number}", texts, rates, longest)


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


def _pairs(data: Trajectories, i: int, count: int) -> list[tuple[str, float]]:
    """Waves of one coordinate whose period is its interval."""
    return _periodic(f"q{i + 1}", _interval(data, [(i, 1.0)])[1], count)


def _of_speed(speed: str, largest: float) -> list[tuple[str, float]]:
    """Waves of a speed, a number or a difference, whose period is its interval."""
    return _periodic(speed, REACH * largest, FRICTION)


def _periodic(x: str, half: float, count: int) -> list[tuple[str, float]]:
    """Pairs of cos and sin of a number whose period is its interval."""
    rates = [j * _short(math.pi / half) for j in range(1, count + 1)]
    return [(f"{f}({k:.10g} {x})", k) for k in rates for f in ("cos", "sin")]


def _plane(data: Trajectories, i: int, j: int) -> list[tuple[str, float]]:
    """Plane waves of two coordinates that are periodic on the rectangle of their intervals, the longest ones first."""
    a, b = (_short(math.pi / _interval(data, [(at, 1.0)])[1]) for at in (i, j))
    every = ((math.hypot(m * a, n * b), m * a, n * b) for m in range(PLANE) for n in range(-PLANE, PLANE))
    found = []
    for k, x, y in sorted(wave for wave in every if wave[1] > 0 or wave[2] > 0)[:PLANE]:
        parts = [f"{abs(w):.10g} q{at + 1}" for w, at in ((x, i), (y, j)) if w]
        found += [(f"{f}({(' - ' if y < 0 else ' + ').join(parts)})", k) for f in ("cos", "sin")]
    return found


def _short(x: float) -> float:
    """A number of seven digits, whose multiples are exact in ten: sines of multiples follow from that of one."""
    return float(f"{x:.7g}")


def _harmonics(i: int) -> list[tuple[str, float]]:
    """Waves of whole multiples of an angle."""
    every = range(1, OF_MANY + 1)
    return [(f"{f}({'' if k == 1 else k}q{i + 1})", float(k)) for k in every for f in ("cos", "sin")]
