"""Rates of waves, and ratios of coordinates, as arguments of a kernel: one kernel serves recordings of every range.

The waves of a learned function are whole multiples j of a longest wave, sin(j (k q + φ)), and k and φ follow from the
range of a recording (`waves`). Compiled as constants, these numbers would ask for a kernel of its own for every
recording. A kernel is therefore traced for standard numbers, and takes those of a model as arguments. So does the ratio
of two coordinates that move in proportion, (20.5 q1 - q2)^2.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.drag import Drag
from herglotz.models.feature_potential import Combination, of_forms
from herglotz.models.features import expand

# A wave, and a number in the argument of a wave with the variable that follows, none for a phase. Whole numbers, such
# as those of the harmonics of an angle, stay constants.
WAVE = re.compile(r"\b(?:cos|sin)\((?:[^()]|\([^()]*\))*\)")
# A power of a form of two coordinates that move in proportion, or of their speeds, with the ratio of the first.
_DECIMAL = r"\d+\.\d*(?:e[-+]?\d+)?|\d+e[-+]?\d+"
RATIO = re.compile(rf"\(-?(?P<number>{_DECIMAL}) [qv](?P<i>\d+) [-+] [qv](?P<j>\d+)\)(?:\^\d+)?")
NUMBER = re.compile(rf"(?<![\w.])(?P<number>{_DECIMAL})(?: ?(?P<of>[qv]\d+|\(v\d+ - v\d+\)))?")
VARIABLE = re.compile(r"[qv]\d+")
# Largest multiple of a base that is looked for.
MOST = 100
# Relative error of a printed multiple: terms have ten digits.
ROUNDING = 1e-9


class Base(NamedTuple):
    """What a number in a wave is a multiple of: the `index`-th base of all numbers of this `kind`.

    Rates of one variable are of one kind if their waves have the same factors. Waves with a phase are of another kind
    than waves without.
    """

    kind: str
    index: int

    @property
    def standard(self) -> float:
        """The number for which kernels are traced: seven digits between 0.5 and 1.5."""
        return round(0.5 + zlib.crc32(f"{self.kind} {self.index}".encode()) % 10**7 / 1e7, 7)


class Rates(NamedTuple):
    """The bases of the numbers in the waves of terms, and the terms that have such numbers with standard numbers."""

    values: dict[Base, float]
    texts: dict[str, str]

    def standard(self, terms: Iterable[str]) -> tuple[str, ...]:
        """These terms with standard numbers."""
        return tuple(self.texts.get(text, text) for text in terms)


@cache
def rates_of(terms: tuple[str, ...]) -> Rates:
    """The bases of the numbers in the waves of these terms, of which all numbers are whole multiples."""
    found: dict[str, list[float]] = {}
    for text in terms:
        for kind, x, _ in _numbers(text):
            found.setdefault(kind, []).append(x)
    bases = {kind: _bases(numbers) for kind, numbers in found.items()}

    def renamed(text: str) -> str:
        """The term with standard numbers."""
        for kind, x, (begin, end) in reversed(list(_numbers(text))):
            i, j = next((i, j) for i, base in enumerate(bases[kind]) if (j := _multiple(x, base)))
            text = f"{text[:begin]}{j * Base(kind, i).standard:.10g}{text[end:]}"
        return text

    values = {Base(kind, i): x for kind, own in bases.items() for i, x in enumerate(own)}
    return Rates(values, {text: own for text in terms if (own := renamed(text)) != text})


def terms_of(config: ModelConfig) -> tuple[str, ...]:
    """The named terms of a model: those of L, and the forces beside L."""
    return (*expand(config.features, config.angles), *config.drag)


def buffers_at(model: ContactLagrangian, bases: Sequence[Base], rates: Tensor) -> dict[str, Tensor]:
    """The buffers of a model with multiples of standard numbers, with `rates` (R,) in the place of these numbers."""
    found: dict[str, Tensor] = {}
    for name, module in model.named_modules() if bases else ():
        with_rates = {Combination: ("form", "phase"), Drag: ("at", "along", "on")}.get(type(module), ())
        for own in with_rates:
            value = module.get_buffer(own)
            entries = value.flatten()
            multiples = [[_multiple(abs(x), base.standard) for base in bases] for x in entries.tolist()]
            signed = entries.sign()[:, None] * value.new_tensor(multiples)
            rest = torch.where(signed.any(-1), 0.0, entries)
            found[f"{name}.{own}"] = (signed @ rates + rest).reshape(value.shape)
        if isinstance(module, Combination):
            forms = of_forms(found[f"{name}.form"], module.arm)
            found |= {f"{name}.{own}": value for own, value in forms.items()}
    return found


def _numbers(text: str) -> Iterator[tuple[str, float, tuple[int, int]]]:
    """The numbers in the waves of a term: kind, number, and where it stands in the text."""
    factors = WAVE.sub("", text).strip()
    if ratio := RATIO.fullmatch(text):
        yield f"{ratio['j']} over {ratio['i']}", float(ratio["number"]), ratio.span("number")
    for wave in WAVE.finditer(text):
        numbers = list(NUMBER.finditer(text, wave.start(), wave.end()))
        shifted = " ".join(VARIABLE.findall(wave[0])) if any(found["of"] is None for found in numbers) else ""
        for found in numbers:
            kind = f"{found['of'] or 'phase'}, factors {factors or 'none'}, shifted {shifted or 'no'}"
            yield kind, float(found["number"]), found.span("number")


def _bases(numbers: list[float]) -> list[float]:
    """Numbers of which all these are whole multiples, as few as small multiples allow."""
    bases: list[float] = []
    for x in numbers:
        for i, base in enumerate(bases):
            ratio = Fraction(x / base).limit_denominator(MOST)
            if 0 < ratio <= MOST and abs(float(ratio) * base / x - 1) <= ROUNDING:
                bases[i] = base / ratio.denominator
                break
        else:
            bases.append(x)
    return bases


def _multiple(x: float, base: float) -> int:
    """The multiple that x is of a base; 0 if x is none."""
    j = round(x / base)
    return j if j and abs(j * base - x) <= ROUNDING * x else 0
