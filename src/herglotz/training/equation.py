"""The learned equation of motion as text: every number that acts in the motion, with units and standard deviations.

If masses do not depend on position there is one line per coordinate, m ẍ = forces, in units in which the first mass
is 1. Other models are printed as L = K − V, the forces, and the law of motion. Numbers have as many digits as the
motion needs, and combinations that the data do not determine are listed below the equation. A network has no formula:
the equation gives the size of its force.
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

# Columns of a line; the screen has two blanks before each line.
WIDTH = 78
BRACKETS = "in brackets: standard deviation, of the last digits or as ±, by noise alone"
WAVE = re.compile(r"(?:sin|cos)\((?P<form>[^()]*)\)(?P<speeds>(?: [^ ()]+′²?)*)")
# More waves of one form with the same speeds are printed as a function, below the lines.
MAX_WAVES = 6
# Lines break between terms, not inside a term.
TOGETHER = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True)
class Term:
    """value · what, on the right-hand side of the equation of one coordinate.

    `left` is the left-hand side, x″ or L; `what` is for example x³, or "" for a constant. `deviation` is the standard
    deviation, and `alone` the standard deviation with all other numbers fixed, which decides the digits (None: not
    computed). A wave of a function has the text of that function, f1(x) x′², in `function`.
    """

    left: str
    what: str
    value: float
    deviation: float | None
    unit: str
    alone: float | None = None
    function: str = ""

    def size(self, digits: int = UNKNOWN) -> str:
        """The printed number without its sign; `digits` applies if no standard deviation is known."""
        return number(abs(self.value), self.deviation, self.alone or self.deviation, digits)

    def text(self, digits: int = UNKNOWN) -> str:
        """The term with its sign."""
        return f"{'−' if self.value < 0 else '+'} {self.size(digits)} {self.what}".rstrip()

    def wave(self, digits: int = UNKNOWN) -> str:
        """The term as a part of its function, without a deviation: a single wave has no meaning of its own."""
        return replace(self, what=self.what.partition(")")[0] + ")", deviation=None).text(digits)


@dataclass(frozen=True, repr=False)
class Equation:
    """The learned equation; `str` gives lines of at most 80 columns, with every number of the model.

    `lefts` are the left-hand sides of the lines, with their masses; `units` reads "x in m, t in s"; `network` describes
    the networks; `notes` hold what an integration needs beside the lines, and what the data do not determine.
    """

    terms: tuple[Term, ...]
    lefts: tuple[str, ...]
    units: str
    network: str | None
    notes: tuple[str, ...] = ()

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
        """The line with this left side, broken between terms; no line for a force of 0."""
        terms = (term for term in self.terms if term.left == left)
        own = (f"+ {term.function}" if term.function else term.text(self._digits) for term in terms)
        # The waves of one function give its name once.
        own = list(dict.fromkeys(own))
        return [] if not own and left.startswith("force on ") else _wrapped(left, own)

    def __repr__(self) -> str:
        return f"Equation({' '.join(str(replace(self, notes=())).split())})"

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

    Standard deviations and digits come from the joint posterior of all numbers. `notes` follow those of the model.
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
    if data.degrees:
        units.append(f"{', '.join(data.degrees)} recorded in deg (1 rad = 57.3 deg)")
    units += [f"t in {data.time_unit}"] if data.time_unit != "1" else []
    every = (*reader.explained(), *notes, *map(str, numbers.trades()))
    if any(term.function for term in terms):
        every = ("f1 and so on: functions of what was recorded alone; beyond its range they are not known", *every)
    return Equation(tuple(terms), tuple(reader.lefts), ", ".join(units) or "plain numbers", network, every)


def network_of(run: FittedRun) -> str | None:
    """The networks of the model in words, with the share of the force where it is known; None without networks."""
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
    """The function with its speeds, for each line that is a wave of it; "" for all other lines."""
    found = []
    for line in lines:
        match = WAVE.fullmatch(line.what)
        of = "" if match is None else ", ".join(dict.fromkeys(re.findall(r"[^\W\d]\w*′?", match["form"])))
        found.append((line.left, of, match["speeds"]) if match and of else None)
    counts, names = Counter(found), {}
    for key in found:
        if key is not None and counts[key] > MAX_WAVES and key not in names:
            names[key] = f"f{len(names) + 1}({key[1]}){key[2]}"
    return [names.get(key, "") for key in found]


def _wrapped(left: str, terms: Sequence[str]) -> list[str]:
    """A line of terms with their signs, broken between them."""
    right, minus = " ".join(x.replace(" ", TOGETHER) for x in terms) or "0", f"−{TOGETHER}"
    right = "−" + right.removeprefix(minus) if right.startswith(minus) else right.removeprefix(f"+{TOGETHER}")
    lines = textwrap.wrap(f"{left} = {right}", WIDTH, subsequent_indent="    ", break_long_words=False)
    return [line.replace(TOGETHER, " ") for line in lines]
