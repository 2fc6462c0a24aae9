"""The learned equation of motion in words: every number of a model that moves it, with units and deviations.

With masses that do not depend on position there is one line a coordinate, m ẍ = forces, in units in which the first
mass is 1. Other models are printed as L = K − V with the forces beside it, and the law of motion below. Numbers are
rounded as the motion needs it, and combinations that the data do not determine are named beside the equation: a term
that is left out moves another model. A network is no formula: the equation says how large its force is.
"""

from __future__ import annotations

import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import torch

from herglotz.models.action import ActionFlow
from herglotz.models.jet import coordinates
from herglotz.training.equation_numbers import Joint, Numbers
from herglotz.training.equation_terms import Line, Reader
from herglotz.training.equation_words import BESIDE, UNKNOWN, number
from herglotz.training.fitted_run import FittedRun

WIDTH = 78  # two blanks stand before each line on screen
BRACKETS = "in brackets: standard deviation, of the last digits or as ±, by noise alone"
WAVE = re.compile(r"(?:sin|cos)\((?P<form>[^()]*)\)(?P<speeds>(?: [^ ()]+′²?)*)")
FEW = 6  # waves of one form with the same speeds that a line has at most: more are a function that is told below
TOGETHER = "\N{NO-BREAK SPACE}"  # inside a term: lines break between terms


@dataclass(frozen=True)
class Term:
    """value · what, on the right-hand side of the equation of one coordinate."""

    left: str  # x″, or L
    what: str  # x³; empty: a constant
    value: float
    deviation: float | None  # standard deviation; None: it was not computed
    unit: str
    alone: float | None = None  # standard deviation with all other numbers held, which rounds the value
    function: str = ""  # of which this is a wave, as it stands in the line: f1(x) x′²; empty: the term stands there

    def size(self, digits: int = UNKNOWN) -> str:
        """The number without its sign, as it is printed; `digits` where nothing tells how many the motion needs."""
        return number(abs(self.value), self.deviation, self.alone or self.deviation, digits)

    def told(self, digits: int = UNKNOWN) -> str:
        """The term with its sign."""
        return f"{'−' if self.value < 0 else '+'} {self.size(digits)} {self.what}".rstrip()

    def wave(self, digits: int = UNKNOWN) -> str:
        """The same as a part of its function, without a deviation: each of its waves alone says nothing."""
        return replace(self, what=self.what.partition(")")[0] + ")", deviation=None).told(digits)


@dataclass(frozen=True, repr=False)
class Equation:
    """The learned equation; `str` gives lines of at most 80 columns, with every number of the model."""

    terms: tuple[Term, ...]
    lefts: tuple[str, ...]  # what stands on the left of each line, with its mass
    units: str  # "x in m, t in s"
    network: str | None  # what a network adds, in words
    notes: tuple[str, ...] = ()  # what the lines need to be integrated, and what the data do not determine

    def __str__(self) -> str:
        lines = [line for left in self.lefts for line in self._lines_of(left)]
        for name in dict.fromkeys(term.function for term in self.terms if term.function):
            waves = [term.wave(self._digits) for term in self.terms if term.function == name]
            lines += _wrapped(name.split(")")[0] + ")", waves)
        if self.network:
            lines += textwrap.wrap(f"    and {self.network}", WIDTH, subsequent_indent="    ")
        sizes = (term.size(self._digits) for term in self.terms if not term.function)
        bracketed = any("(" in x for x in (*self.lefts, *sizes))
        told = f"with {self.units}; {BRACKETS}" if bracketed else f"with {self.units}"
        for note in (told, *self.notes):
            lines += textwrap.wrap(note, WIDTH, break_long_words=False)
        return "\n".join(lines)

    @property
    def _digits(self) -> int:
        return BESIDE if self.network else UNKNOWN

    def _lines_of(self, left: str) -> list[str]:
        """The line with this left side, broken between terms; nothing of a force that is 0."""
        terms = (term for term in self.terms if term.left == left)
        own = (f"+ {term.function}" if term.function else term.told(self._digits) for term in terms)
        own = list(dict.fromkeys(own))  # a function once
        return [] if not own and left.startswith("force on ") else _wrapped(left, own)

    def __repr__(self) -> str:
        return f"Equation({' '.join(str(replace(self, notes=())).split())})"  # what stands below it is long

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON: the terms, and the same as text."""
        rest = {"lefts": list(self.lefts), "units": self.units, "network": self.network, "notes": list(self.notes)}
        return {"text": str(self), "terms": [asdict(term) for term in self.terms], **rest}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Equation:
        """Inverse of `as_dict`."""
        terms, notes = tuple(Term(**term) for term in values["terms"]), tuple(values.get("notes", ()))
        return cls(terms, tuple(values["lefts"]), values["units"], values["network"], notes)


def equation_of(run: FittedRun, joint: Joint | None = None, notes: Sequence[str] = ()) -> Equation:
    """The equation of a run's model, in the data's units; the first mass is 1.

    Standard deviations, and the digits that the motion needs, come from what the data say of all numbers together.
    More `notes` stand behind those of the model.
    """
    network = network_of(run)
    numbers = Numbers(run.model, joint, BESIDE if network else UNKNOWN)
    reader, terms = Reader(run, numbers), []
    lines = list(reader.lines())
    for x, function in zip(lines, _functions(lines), strict=True):
        words = (x.what or "the constant") + (f" of {x.of or 'L'}" if len(reader.lefts) > 1 else "")
        value, deviation, alone = numbers.known(x.value, "" if function else words)
        terms.append(Term(x.left, x.what, value, deviation, x.unit, alone, function))
    data = run.data
    labels = (*zip(data.names, data.units, strict=True), *(data.input_labels if run.model.inputs else ()))
    units = [f"{name} in {unit}" for name, unit in labels if unit not in ("", "1")]
    if data.degrees:  # the derivatives of sines and powers are those of radians
        units.append(f"{', '.join(data.degrees)} recorded in deg (1 rad = 57.3 deg)")
    units += [f"t in {data.time_unit}"] if data.time_unit != "1" else []
    every = (*reader.explained(), *notes, *map(str, numbers.trades()))
    if any(term.function for term in terms):
        every = ("f1 and so on: functions of what was recorded alone; beyond its range they are not known", *every)
    return Equation(tuple(terms), tuple(reader.lefts), ", ".join(units) or "plain numbers", network, every)


def network_of(run: FittedRun) -> str | None:
    """What networks add, in words; None without."""
    model, config = run.model, run.model.config
    parts = []
    if not config.baseline:
        return "a network, which is all the rest of L_d"
    if model.potential.network is not None:
        rows = run.data.q.to(next(model.parameters()))
        with torch.no_grad():
            own = model.potential.departure(coordinates(rows, 1))
            whole = model.potential(rows, 1)
        assert own is not None
        share = float((own.gradient.square().mean() / whole.gradient.square().mean()).sqrt())
        parts.append(f"a network in the potential, {100 * share:.3g} % of the conservative force")
    if model.correction is not None:
        parts.append("a network that corrects the rule at this step")
    if config.mass_width:
        parts.append("a network in the mass")
    if isinstance(model.action, ActionFlow) or getattr(model.damping, "network", None) is not None:
        parts.append(f"damping of the level '{config.level}', which depends on the state")
    parts += [f"the term '{name}'" for name in config.terms]
    return ", ".join(parts) or None


def _functions(lines: Iterable[Line]) -> list[str]:
    """The function that each line is a wave of, with the speeds beside it; "" of a line that stands by itself."""
    found = []
    for line in lines:
        match = WAVE.fullmatch(line.what)
        of = "" if match is None else ", ".join(dict.fromkeys(re.findall(r"[^\W\d]\w*′?", match["form"])))
        found.append((line.left, of, "" if match is None else match["speeds"]) if of else None)
    counts, names = Counter(found), {}
    for key in found:
        if key is not None and counts[key] > FEW and key not in names:
            names[key] = f"f{len(names) + 1}({key[1]}){key[2]}"
    return [names.get(key, "") for key in found]


def _wrapped(left: str, terms: Sequence[str]) -> list[str]:
    """A line of terms with their signs, broken between them."""
    right, minus = " ".join(x.replace(" ", TOGETHER) for x in terms) or "0", f"−{TOGETHER}"
    right = "−" + right.removeprefix(minus) if right.startswith(minus) else right.removeprefix(f"+{TOGETHER}")
    lines = textwrap.wrap(f"{left} = {right}", WIDTH, subsequent_indent="    ", break_long_words=False)
    return [line.replace(TOGETHER, " ") for line in lines]
