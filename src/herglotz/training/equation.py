"""The learned equation of motion in words: the named terms of a model with their numbers, units and deviations.

With masses that do not depend on position there is one line a coordinate, m ẍ = forces, in units in which the first
mass is 1. Other models are printed as L = K − V with the forces beside it. A network is no formula: the equation says
how large its force is.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from herglotz.models import ContactLagrangian
from herglotz.models.drag import parse_drag
from herglotz.models.feature_potential import baseline_is_named
from herglotz.models.features import expand, parse
from herglotz.models.jet import coordinates
from herglotz.models.terms import Kinetic
from herglotz.models.translations import across_in_words
from herglotz.training.equation_words import drag_in_words, feature_in_words, number, raised, slope, unit_of
from herglotz.training.fitted_run import FittedRun
from herglotz.training.parameter_vector import ParameterVector

WIDTH = 78  # two blanks stand before each line on screen
BRACKETS = "in brackets: standard deviation of the last digits by noise alone, without the error of the time step"
TOGETHER = "\N{NO-BREAK SPACE}"  # inside a term: lines break between terms


@dataclass(frozen=True)
class Term:
    """value · what, on the right-hand side of the equation of one coordinate."""

    left: str  # x″, or L
    what: str  # x³; empty: a constant
    value: float
    deviation: float | None  # standard deviation; None: it was not computed
    unit: str

    @property
    def shown(self) -> bool:
        """Whether the data tell the value from 0: it is beyond two standard deviations, or these are not known."""
        return self.deviation is None or abs(self.value) > 2 * self.deviation

    def __str__(self) -> str:
        sign = "−" if self.value < 0 else "+"
        return f"{sign} {number(abs(self.value), self.deviation)} {self.what}".rstrip()


@dataclass(frozen=True, repr=False)
class Equation:
    """The learned equation; `str` gives lines of at most 80 columns, without terms that the data do not tell from 0.

    Where they tell none of a line's terms, all of them are shown, with their deviations.
    """

    terms: tuple[Term, ...]
    lefts: tuple[str, ...]  # what stands on the left of each line, with its mass
    units: str  # "x in m, t in s"
    network: str | None  # what a network adds, in words

    def __str__(self) -> str:
        lines, bracketed = [], False
        for left in self.lefts:
            every = [term for term in self.terms if term.left == left]
            own = [term for term in every if term.shown] or every
            bracketed = bracketed or any("(" in number(abs(x.value), x.deviation) for x in own)
            right = " ".join(str(term).replace(" ", TOGETHER) for term in own) or "0"
            minus = f"−{TOGETHER}"
            right = "−" + right.removeprefix(minus) if right.startswith(minus) else right.removeprefix(f"+{TOGETHER}")
            wrapped = textwrap.wrap(f"{left} = {right}", WIDTH, subsequent_indent="    ", break_long_words=False)
            lines += [line.replace(TOGETHER, " ") for line in wrapped]
        if self.network:
            lines += textwrap.wrap(f"    and {self.network}", WIDTH, subsequent_indent="    ")
        told = f"with {self.units}; {BRACKETS}" if bracketed else f"with {self.units}"
        return "\n".join([*lines, *textwrap.wrap(told, WIDTH)])

    def __repr__(self) -> str:
        return f"Equation({' '.join(str(self).split())})"

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON: the terms, and the same as text."""
        rest = {"lefts": list(self.lefts), "units": self.units, "network": self.network}
        return {"text": str(self), "terms": [asdict(term) for term in self.terms], **rest}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Equation:
        """Inverse of `as_dict`."""
        terms = tuple(Term(**term) for term in values["terms"])
        return cls(terms, tuple(values["lefts"]), values["units"], values["network"])


def equation_of(run: FittedRun, covariance: Tensor | None = None) -> Equation:
    """The equation of a run's model, in the data's units; the first mass is 1.

    Standard deviations come from the `covariance`, (P, P), of the numbers that were fitted (`training.laplace`).
    """
    terms = []
    at = {entry: k for k, entry in enumerate(ParameterVector(run.model).entries)}
    for left, what, unit, parts in _Reader(run).parts():
        value = sum(by * float(run.model.get_parameter(name).detach().reshape(-1)[i]) for name, i, by in parts)
        deviation = None
        if covariance is not None:
            w = covariance.new_zeros(len(covariance))
            for name, i, by in parts:
                if (name, i) in at:
                    w[at[name, i]] += by
            deviation = math.sqrt(max(0.0, float(w @ covariance @ w)))
        if value != 0.0:
            terms.append(Term(left, what, value, deviation, unit))
    terms[:0] = [*_kinetic(run), *_relative_springs(run)]
    data = run.data
    labels = (*zip(data.names, data.units, strict=True), *(data.input_labels if run.model.inputs else ()))
    units = [f"{name} in {unit}" for name, unit in labels if unit not in ("", "1")]
    if data.degrees:  # the derivatives of sines and powers are those of radians
        units.append(f"{', '.join(data.degrees)} recorded in deg (1 rad = 57.3 deg)")
    units += [f"t in {data.time_unit}"] if data.time_unit != "1" else []
    return Equation(tuple(terms), tuple(_lefts(run)), ", ".join(units) or "plain numbers", network_of(run))


Part = tuple[str, int, float]  # parameter, entry, factor
Line = tuple[str, str, str, list[Part]]  # left side, text, unit and parameters of a term


def _lefts(run: FittedRun) -> list[str]:
    if not _newtonian(run.model):
        return ["L", *(f"force on {name}" for name in run.data.names)]
    kinetic, names = run.model.kinetic, run.data.names
    mass = [f"{m:.4g} " for m in kinetic.mass().detach().diagonal().tolist()]  # type: ignore[operator]
    return [f"{m.removeprefix('1 ')}{name}″" for m, name in zip(mass, names, strict=True)]


def _kinetic(run: FittedRun) -> list[Term]:
    """½ vᵀ M v with the constant M that named products of speeds add to, where L is printed as one function."""
    kinetic = getattr(run.model.kinetic, "base", run.model.kinetic)
    if _newtonian(run.model) or not isinstance(kinetic, Kinetic) or not run.model.config.baseline:
        return []
    mass, names = kinetic.mass().detach(), run.data.names
    return [
        Term("L", f"{names[i]}′²" if i == j else f"{names[i]}′ {names[j]}′", value, None, "")
        for i in range(len(names))
        for j in range(i, len(names))
        if (value := float(mass[i, j]) * (0.5 if i == j else 1.0)) != 0.0
    ]


def _relative_springs(run: FittedRun) -> list[Term]:
    """−½ k (Pq)² − b (Pq) of a model with translations, whose baseline acts on the projected position."""
    V, sums = run.model.potential, {}
    forms = [] if V.across is None else across_in_words(V.across, run.data.names)
    for (x, w), angle, k, b in zip(forms, V.angles, V.stiffness.tolist(), V.tilt.tolist(), strict=False):
        both = ((f"cos {x}", k), (f"sin {x}", -b)) if angle else ((f"{x}²", -k * w**2 / 2), (x, -b * w))
        for what, value in both if x else ():
            sums[what] = sums.get(what, 0.0) + value
    return [Term("L", what, value, None, "") for what, value in sums.items() if value]


def _newtonian(model: ContactLagrangian) -> bool:
    """Whether every coordinate has an equation of its own: one mass each."""
    made_of, config = model.capabilities, model.config
    return made_of.constant_mass and (config.dof == 1 or config.diagonal or config.alike)


class _Reader:
    """The terms of a run's model: left side, text, unit and parameters of each."""

    def __init__(self, run: FittedRun):
        self.run, self.data, self.config, self.time = run, run.data, run.model.config, run.data.time_unit
        self.lefts, self.newton = _lefts(run), _newtonian(run.model)
        self.named = dict(run.model.named_parameters())

    def parts(self) -> Iterator[Line]:
        """Those of every term."""
        data, config = self.data, self.config
        for i in range(config.dof):
            yield from self._friction(i, self.lefts[i if self.newton else i + 1])
        for i, angle in enumerate(data.angles):
            for power, (parameter, entry, by) in self._springs(i, angle):
                what, factor = own_term(data.names[i], angle, power, self.newton)
                size = unit_of(data.units[i], 1 if angle else 2 - power, self.time, 2) if self.newton else ""
                yield self.lefts[i] if self.newton else "L", what, size, [(parameter, entry, factor * by)]
        texts = expand(config.features, config.angles)
        offset = 2 * config.dof if baseline_is_named(config) else 0
        still = [text for text in texts if not parse(text, config.angles)[0].velocities]
        for g, text in enumerate(still):
            yield from self._feature(text, ("potential.features.sum.coefficient", offset + g))
        for g, text in enumerate(text for text in texts if text not in still):
            yield "L", feature_in_words(text, data.names), "", [("kinetic.sum.coefficient", g, 1.0)]

    def _springs(self, i: int, angle: bool) -> list[tuple[int, Part]]:
        """The power of a coordinate in its stiffness and its tilt, with the part of each."""
        coefficient = "potential.features.sum.coefficient"
        if "potential.stiffness" in self.named:
            return [(2, ("potential.stiffness", i, 1.0)), (1, ("potential.tilt", i, 1.0))]
        if baseline_is_named(self.config):  # −k, b of an angle; k/2, b of a length
            return [(2, (coefficient, 2 * i, -1.0 if angle else 2.0)), (1, (coefficient, 2 * i + 1, 1.0))]
        return []

    def _friction(self, i: int, left: str) -> Iterator[Line]:
        run, config, named, time = self.run, self.config, self.named, self.time
        name, unit, parts = self.data.names[i], self.data.units[i], []
        if "damping.rate" in named and self.newton:  # the contact form damps every momentum alike
            parts.append(("damping.rate", 0, -float(run.model.kinetic.mass().detach()[i, i])))  # type: ignore[operator]
        elif "damping.rate" in named and i == 0:
            yield "L", "s", unit_of("1", 0, time, 1), [("damping.rate", 0, -1.0)]
        parts += [("friction.viscous", i, -1.0)] if "friction.viscous" in named else []
        if parts:
            yield left, f"{name}′", unit_of(unit, 0, time, 1), parts
        for g, text in enumerate(config.drag):
            f = parse_drag(text, config.angles)
            if f.air or i in (f.on, f.of):
                what, by = drag_in_words(f, i, self.data.names), 1.0 if f.of == i else -1.0
                size = unit_of(unit, 1 - f.a - f.b - f.c, time, 2 - f.b - f.c)
                yield left, what, size, [("drag.coefficient", g, by)]
        if config.coulomb:
            yield left, f"sgn({name}′)", unit_of(unit, 1, time, 2), [("friction.coulomb", i, -1.0)]
            friction = run.model.friction
            assert friction is not None  # dry friction is part of it
            width = (friction.sharpest + friction.log_stribeck.exp()).detach()
            shape = f"exp(−({name}′/{float(width[i]):.3g})²) sgn({name}′)"
            yield left, shape, unit_of(unit, 1, time, 2), [("friction.breakaway", i, -1.0)]
        for j in range(config.inputs if "friction.input_map" in named else 0):
            yield left, self._input(j), "", [("friction.input_map", i * config.inputs + j, 1.0)]

    def _input(self, j: int) -> str:
        """The input less what its sensor shows where nothing acts."""
        what, friction = self.data.input_labels[j][0], self.run.model.friction
        zero = 0.0 if friction is None or friction.input_zero is None else float(friction.input_zero[j].detach())
        return f"({what} {'−' if zero > 0 else '+'} {abs(zero):.3g})" if zero else what

    def _feature(self, text: str, at: tuple[str, int]) -> Iterator[Line]:
        """A feature of the potential: its force on each coordinate, or its part of L."""
        names, units = self.data.names, self.data.units
        if not self.newton:
            yield "L", feature_in_words(text, names), "", [(*at, -1.0)]
            return
        for i in range(len(names)):
            for product in parse(text, self.config.angles):
                if product.function == "radius" or product.form[i]:
                    what, by, power = slope(product, i, names)
                    yield self.lefts[i], what, unit_of(units[i], power, self.time, 2), [(*at, -by)]


def own_term(name: str, angle: bool, power: int, newton: bool) -> tuple[str, float]:
    """Text and factor of a term of the potential k (1 − cos q) + b sin q, or k q²/2 + b q: of its force, or in L."""
    if newton:
        return (f"sin {name}" if power == 2 else f"cos {name}") if angle else (name if power == 2 else ""), -1.0
    if angle:
        return (f"cos {name}", 1.0) if power == 2 else (f"sin {name}", -1.0)
    return raised(name, power), -0.5 if power == 2 else -1.0


def network_of(run: FittedRun) -> str | None:
    """What networks add, in words; None without."""
    model, config = run.model, run.model.config
    parts = []
    if not config.baseline:
        return "nothing: a network is the whole of L_d"
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
    if config.level in ("affine", "full"):
        parts.append(f"damping of the level '{config.level}', which depends on the state")
    return ", ".join(parts) or None
