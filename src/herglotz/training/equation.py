"""The learned equation of motion as text: every number that acts in the motion, with units and standard deviations.

If masses do not depend on position there is one line per coordinate, m ẍ = forces, in units in which the first mass
is 1. Other models are printed as L = K − V, the forces, and the law of motion. Numbers have as many digits as the
motion needs. A network has no formula: the equation gives the size of its force. Notes below the equation list what an
integration needs (timing of inputs, zeros of sensors, the model's step and rule), and combinations that the data do not
determine.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from herglotz.data.input_terms import input_terms_of
from herglotz.data.trajectories import GAP
from herglotz.data.units import common_unit, size
from herglotz.errors import InputError
from herglotz.models import refuse_own
from herglotz.models.action import ActionFlow
from herglotz.models.jet import coordinates
from herglotz.training.baseline import JITTER
from herglotz.training.equation_terms import Line, Reader, is_formula, mentions, newtonian
from herglotz.training.equation_words import BESIDE, UNKNOWN, Joint, Numbers, number, plain
from herglotz.training.feedback import acting_inputs
from herglotz.training.fitted_run import FittedRun
from herglotz.training.free_run import run_on
from herglotz.training.plan import MAX_WAVES
from herglotz.training.sensor_zeros import CENTRE

# Columns of a line; the screen has two blanks before each line.
WIDTH = 78
BRACKETS = "in brackets: standard deviation, of the last digits or as ±, by noise alone"
WAVE = re.compile(r"(?:sin|cos)\((?P<form>[^()]*)\)(?P<speeds>(?: [^ ()]+′²?)*)")
# Most waves of a function that are printed on the screen: five lines.
ON_SCREEN = 24
# Lines break between terms, not inside a term.
TOGETHER = "\N{NO-BREAK SPACE}"
# Digits of the zero and the scale of a sensor.
DIGITS = 7
# Richardson: halved steps remove three quarters of an error of order 2. Forces are of order 2 in rules of order 4 too.
HALVED = 4 / 3
BETWEEN = {
    "zero": "held from each sample to the next",
    "first": "straight between the samples",
    "smooth": "polynomials between the samples",
}
# The rule of the model, printed if an exact integration departs from its steps (`models/terms.py`, `models/order4.py`).
RULE = (
    "step it as the model does: c p + ∂L_d/∂q + c (h/2) f = 0, p₊ = ∂L_d/∂q₊ + (h/2) f, s₊ = s + L_d with {parts}, "
    "c = exp(h ∂L/∂s) and L_d = {L_d}; K, ∂L/∂s and f are taken at q̄ = (q + q₊)/2 and v = (q₊ − q)/h{dry}"
)
# L_d of the rules of order 2 and 4.
OF_ORDER = {
    2: "(c − 1)(s − (h/2) V(q)) + √c h K − (h/2)(V(q) + V(q₊))",
    4: "(c − 1) s + √c (h K + (h³/24)(K_qq[v, v] + 2γ K_q v + γ² K − eᵀM⁻¹e)) − (h/6)(c V(q) + 4 √c V(q̄) + V(q₊)), "
    "e = K_q − V_q − K_qv v − γ K_v, M = K_vv",
}
# The rule with powers of s in L.
BY_POWERS = (
    "step it as the model does: c p + ∂L_d/∂q + c (h/2) f = 0, p₊ = ∂L_d/∂q₊ + (h/2) f, c = 1 + ∂L_d/∂s, f the forces; "
    "L_d is what s gains from − (h/2) V(q), half a step of s′ = −β sᵖ of each power of s, half a step of s′ = −γ s, "
    "h K, and the same backwards with V(q₊); K and f are taken at q̄ = (q + q₊)/2 and v = (q₊ − q)/h"
)
DRY = ", but dry friction, of q and v, acts by h in place of h/2 in the first of them, and not in the second"


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

    def is_seen(self, digits: int = UNKNOWN) -> bool:
        """Whether a digit other than 0 is printed, of the number or of its deviation: 0e-161 says nothing."""
        shown = self.wave(digits).split()[1] if self.function else self.size(digits)
        return (self.value == 0 and not self.function) or any(x in "123456789" for x in shown.partition("e")[0])


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
        return self.text()

    def text(self, most: float = math.inf) -> str:
        """The lines; of functions with more than `most` waves their number alone."""
        lines = [line for left in self.lefts for line in self._lines_of(left)]
        seen = [term for term in self.terms if term.is_seen(self._digits)]
        for name in dict.fromkeys(term.function for term in seen if term.function):
            waves = [term.wave(self._digits) for term in seen if term.function == name]
            told = waves if len(waves) <= most else [f"+ a sum of {len(waves)} waves (metrics.json)"]
            lines += _wrapped(name.split(")")[0] + ")", told)
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
        terms = (term for term in self.terms if term.left == left and term.is_seen(self._digits))
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
    silent = {own for own in input_terms_of(data.columns) if not any(own in term.what for term in terms)}
    units = [f"{name} in {unit}" for name, unit in labels if unit not in ("", "1") and name not in silent]
    if data.degrees:
        units.append(f"{', '.join(data.degrees)} recorded in deg (1 rad = 57.3 deg)")
    units += [f"t in {data.time_unit}"] if data.time_unit != "1" else []
    told = (without_bound(terms, data.names), *map(str, numbers.trades()))
    every = (*reader.explained(), *notes, *filter(None, told))
    if any(term.function for term in terms):
        every = ("f1 and so on: functions of what was recorded alone; beyond its range they are not known", *every)
    return Equation(tuple(terms), tuple(reader.lefts), ", ".join(units) or "plain numbers", network, every)


def without_bound(terms: Sequence[Term], names: Sequence[str]) -> str:
    """The note on coordinates whose mass in L the data do not bound; "" for none.

    The deviation of the mass exceeds the mass, and so for every term of this coordinate alone: the accelerations are
    known, and what the other coordinates do to such a coordinate is not.
    """
    found = []
    for name in names:
        others = [other for other in names if other != name]
        own = [x for x in terms if x.left in ("L", f"force on {name}") and mentions(f"{x.what} {x.left}", [name])]
        own = [x for x in own if not mentions(x.what, others)]
        is_open = all(x.deviation is not None and x.deviation > abs(x.value) for x in own)
        if is_open and len(own) > 1 and any(x.what == f"{name}′²" for x in own):
            found.append(name)
    if not found:
        return ""
    one = len(found) == 1
    return (
        f"the mass{'' if one else 'es'} of {', '.join(found)} {'is' if one else 'are'} not determined: what the other "
        f"coordinates do to {'it' if one else 'each'} is too small to be seen, as where a drive moves {found[0]}; the "
        f"motion stays the same if all terms of {found[0]} alone, mass and forces, are multiplied by one number"
    )


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


def notes_of(run: FittedRun, printed: FittedRun | None = None) -> tuple[str, ...]:
    """The notes of a run, whose equation has the numbers of `printed`, by default its own; empty ones are left out."""
    refuse_own(run.model, "printed equation", "run.continuous evaluates its force, energy and Lagrangian")
    return tuple(filter(None, (_inputs(run), _sensors(run), _steps(run, printed or run))))


def _inputs(run: FittedRun) -> str:
    if not run.model.inputs or run.decided.frequencies:
        return ""
    hold, unit = run.arrival.hold, "" if run.data.time_unit == "1" else f" {run.data.time_unit}"
    every, acting = [name for name, _ in run.data.input_labels], set(acting_inputs(run.model))
    if idle := ", ".join(name for k, name in enumerate(every) if k not in acting):
        idle = f"{idle}: without effect of its own, and still an argument of the model's steps"
    if not acting:
        return idle
    names = ", ".join(name for k, name in enumerate(every) if k in acting)
    delay, lag = run.arrival.late
    late = [f"acting {delay:.6g}{unit} later"] if delay else []
    late += [f"through a lag T = {lag:.6g}{unit}, T f′ = {names} − f, f being what acts"] if lag else []
    late += ["taken as exact in the deviations above"] if late else []
    acts = ", ".join([f"{names}: {BETWEEN.get(hold or 'zero', hold)}", *late])
    return f"{acts}; {idle}" if idle else acts


def _sensors(run: FittedRun) -> str:
    """How the reading of a sensor becomes a coordinate of the equation."""
    names, found, plan = run.data.names, [], run.metrics.get("plan") or {}
    centred = plan.get("reasons", {}).get("zeros", "").startswith(CENTRE)
    for of, numbers in (
        ("times the scale of its sensor", run.reading.get("sensor_scales")),
        ("less the zero of its sensor", run.reading.get("sensor_zeros")),
        ("less the place that terms are about" if centred else "less the zero of its sensor", plan.get("zeros")),
        ("less t since its recording began times the drift of its sensor", plan.get("drifts")),
    ):
        values = [plain(float(x), DIGITS) for x in numbers or ()]
        each = [f"{name} {', '.join(values[i :: len(names)])}" for i, name in enumerate(names)] if values else []
        several = ", recording after recording" if len(values) > len(names) else ""
        found += [f"{of} ({'; '.join(each)}{several})"] if values else []
    angles = [name for name, unit in zip(names, run.data.units, strict=True) if unit == "rad"]
    words = [f"a coordinate is its reading {', '.join(found)}"] if found else []
    words += [] if plan.get("turning", True) else [
        f"the readings of {', '.join(angles)} count turns from the first sample of a recording: the turn in which a "
        "sensor that wraps begins is not recorded, and herglotz predict finds that of another recording"
    ]  # fmt: skip
    return "; ".join(words)


def _steps(run: FittedRun, printed: FittedRun) -> str:
    """The model's step and rule, and the distance of the exact motion of the equation from the model's motion."""
    time, model = "" if run.data.time_unit == "1" else f" {run.data.time_unit}", run.model
    what = f"the model's steps are {run.h:.7g}{time}, its rule of order {model.config.order}"
    found = departure(run, printed)
    if found is None:
        return what
    what += "" if printed is run else ", and the equation has the numbers to which its own tend as steps get shorter"
    unit = common_unit(run.data.units)
    by = f"{size(found.moved, unit, bool(run.data.degrees))}, " if unit or run.data.dof == 1 else ""
    ratio = f"{found.moved / found.missed:.2g} times what it misses the data by"
    told = f"{what}; integrated exactly, the equation departs from it by {by}{ratio}"
    if found.moved <= found.missed:
        return told
    if model.config.dissipation:
        return f"{told}: {BY_POWERS}"
    parts = "L = K − V + s ∂L/∂s, f the forces"
    if newtonian(model):
        rate = 0.0 if model.damping is None else float(model.damping.rate.detach())  # type: ignore[operator]
        loads = ", constants on angles among them" if any(text.startswith("load") for text in model.config.drag) else ""
        parts = f"L = K − V − γ s, γ = {plain(rate, DIGITS)}, V of the forces by position alone, f the others "
        parts += f"without −γ m v{loads}"
    dry = DRY if model.friction is not None and model.friction.sticking else ""
    return f"{told}: {RULE.format(parts=parts, L_d=OF_ORDER[model.config.order], dry=dry)}"


class Departure(NamedTuple):
    """RMS over all coordinates, each over its balance.

    `moved` is the distance of the model's motion from the exact motion of its equation, `missed` that from the data.
    """

    moved: float
    missed: float


def departure(run: FittedRun, printed: FittedRun | None = None) -> Departure | None:
    """Errors of free runs of all recordings; the equation has the numbers of `printed`, by default those of the run.

    The exact motion of the equation is extrapolated from whole and halved steps. None if a run fails or leaves the
    world, the model fits the data exactly, or the equation is not the whole model.
    """
    data, printed = run.data.unwrapped(), printed or run
    if not is_formula(run.model) or _is_lost(run):
        return None
    longest = longest_step(run)
    try:
        whole, halved = (free_run(printed, max_step) for max_step in (longest, longest / 2))
        own = whole if printed is run else free_run(run, longest)
    except InputError:
        return None
    changes = own - data.q, whole + HALVED * (halved - whole) - own
    missed, moved = (float((x / data.balance).square().mean().sqrt()) for x in changes)
    return Departure(moved, missed) if missed > 0 and math.isfinite(moved) and math.isfinite(missed) else None


def _is_lost(run: FittedRun) -> bool:
    """Whether the free run misses the data by more than an unrelated motion of the same spread would, √2 of it."""
    q = run.data.q / run.data.balance
    missed = (run.prediction.detach().to(q) / run.data.balance - q).square().mean()
    return not bool(missed <= 2 * (q - q.mean(0)).square().mean())


def longest_step(run: FittedRun) -> float:
    """The longest model step along a recording."""
    return GAP * run.h if run.decided.substeps == 1 else JITTER * run.h


def free_run(run: FittedRun, max_step: float) -> Tensor:
    """Positions of free runs of all recordings from their first states, with steps up to `max_step`, (N, n).

    NaN if the runs cannot be solved at once: they end, or are not near the data.
    """
    data, states = run.data.unwrapped(), run.states.joined.detach().clone()
    run_on(run.stepper, data, states, (1,) * len(data), max_step, one_by_one=False)
    return states[:, : data.dof].detach()
