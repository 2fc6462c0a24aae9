"""The terms of a model's motion: left side, text, unit and coefficient of each term.

A coefficient is a tensor made from the parameters, so that autograd gives its derivatives. Numbers inside a text, for
example the width of a tanh or the zero of an input, are rounded by the same rule as coefficients.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import torch
from torch import Tensor

from herglotz.models import ContactLagrangian
from herglotz.models.action import ActionFlow, ActionPowers
from herglotz.models.config import POWERS
from herglotz.models.drag import parse_drag
from herglotz.models.feature_potential import Combination, baseline_is_named, sorted_features
from herglotz.models.features import Feature
from herglotz.models.terms import AffineDamping, FeatureKinetic, Kinetic, LinearDamping
from herglotz.models.translations import across_in_words
from herglotz.training.equation_words import (
    Numbers,
    distance,
    drag_in_words,
    feature_in_words,
    own_term,
    raised,
    slopes,
    unit_of,
)
from herglotz.training.fitted_run import FittedRun

MORE = "what is no formula moves the model, too: these lines alone are another motion; herglotz export writes all of it"


@dataclass(frozen=True)
class Line:
    """The term value · what on the right-hand side of the line of coordinate `of`; in L if `of` is ""."""

    left: str
    what: str
    unit: str
    value: Tensor  # ()
    of: str = ""


def mentions(text: str, names: Iterable[str]) -> bool:
    """True if the text contains one of these names, alone or with an exponent."""
    return any(re.search(rf"(?<!\w){re.escape(name)}(?![^\W⁰¹²³⁴⁵⁶⁷⁸⁹])", text) for name in names)


def is_formula(model: ContactLagrangian) -> bool:
    """True if the lines are the whole model: no network, and no `Term`, whose formula is unknown."""
    in_s = model.action if isinstance(model.action, ActionFlow) else None
    networks = (model.potential.network, model.correction, in_s, getattr(model.damping, "network", None))
    named = model.config.baseline and not model.config.mass_width and not model.config.terms
    return named and all(network is None for network in networks)


def newtonian(model: ContactLagrangian) -> bool:
    """True if every coordinate has its own equation: one mass each, and no action s in the motion."""
    made_of, config = model.capabilities, model.config
    if not config.baseline or not made_of.constant_mass or made_of.carries_s:
        return False
    if config.dof == 1 or config.diagonal or config.alike:
        return True
    # A search may have left out every mass between two coordinates.
    return sum("off_diagonal" in name for name in config.absent) == config.dof * (config.dof - 1) // 2


class Reader:
    """Reads the terms off a run's model: M q̈ = forces with one line per coordinate, or L and the forces."""

    def __init__(self, run: FittedRun, numbers: Numbers):
        self.model, self.data, self.shown = run.model, run.data, numbers.shown
        self.config, self.names, self.time = run.model.config, run.data.names, run.data.time_unit
        self.newton, self.distance = newtonian(run.model), distance(run.data.names)
        self.own = [f"{name}″" if self.newton else f"force on {name}" for name in self.names]
        # `lines` puts the masses in front.
        self.lefts = self.own if self.newton else ["L", *self.own]
        self.line_of = dict(zip(self.own, self.names, strict=True))

    def lines(self) -> list[Line]:
        """The lines of all terms with a coefficient other than 0."""
        own = (line for i in range(len(self.own)) for line in (*self._viscous(i), *self._dry(i)))
        parts = (self._kinetic(), self._damping(), own, self._drag(), self._inputs(), self._springs(), self._features())
        found = [replace(line, of=self.line_of.get(line.left, "")) for part in parts for line in part]
        found = [line for line in found if float(line.value.detach()) != 0.0]
        return self._over_masses(found) if self.newton else found

    def _over_masses(self, lines: Sequence[Line]) -> list[Line]:
        """The lines of M q̈ = forces. If coordinates share a force, their masses stand on the left.

        Each line of an uncoupled coordinate is divided by that coordinate's mass, which the motion does not determine.
        """
        found = list(lines)
        for k, (m, own, name) in enumerate(zip(self._masses().diagonal(), self.own, self.names, strict=True)):
            others = {*self.names, self.distance} - {name}
            if any(mentions(line.what, others if line.left == own else {name}) for line in lines):
                mass = self.shown(m, f"the mass of {name}", True)
                self.lefts = [*self.lefts[:k], f"{'' if mass == '1' else mass + ' '}{own}", *self.lefts[k + 1 :]]
                found = [replace(line, left=self.lefts[k]) if line.left == own else line for line in found]
            else:
                found = [replace(line, value=line.value / m) if line.left == own else line for line in found]
        return found

    def _masses(self) -> Tensor:
        """The constant mass matrix, (n, n)."""
        kinetic = getattr(self.model.kinetic, "base", self.model.kinetic)
        assert isinstance(kinetic, Kinetic)
        return kinetic.mass()

    def _kinetic(self) -> Iterator[Line]:
        """½ vᵀ M v with a constant M, and features with velocities, if L is printed as one function."""
        kinetic, names = self.model.kinetic, self.names
        if self.newton or not self.config.baseline:
            return
        if isinstance(getattr(kinetic, "base", kinetic), Kinetic):
            mass = self._masses()
            for i, j in combinations_with_replacement(range(len(names)), 2):
                speeds = f"{names[i]}′²" if i == j else f"{names[i]}′ {names[j]}′"
                yield Line("L", speeds, "", mass[i, j] * (0.5 if i == j else 1.0))
        if isinstance(kinetic, FeatureKinetic):
            learned, known = (
                sorted_features(x, self.config.angles)[1] for x in (self.config.features, self.config.known)
            )
            for feature, value in self._numbers(kinetic.sum, learned, known):
                yield Line("L", feature_in_words(feature, names), "", value)

    def _damping(self) -> Iterator[Line]:
        """Damping by the action, in L; for separate masses `_viscous` has it."""
        damping = self.model.damping
        if not isinstance(damping, (LinearDamping, AffineDamping)) or self.newton:
            return
        yield Line("L", "s", unit_of("1", 0, self.time, 1), -damping.rate)
        if isinstance(self.model.action, ActionPowers):
            for name, value in zip(self.config.dissipation, self.model.action.coefficient, strict=True):
                yield Line("L", raised("s", POWERS[name]), "", -value)
        if isinstance(damping, AffineDamping):
            for i, name in enumerate(self.names):
                yield Line("L", f"{name}′ s", "", damping.drag[i])

    def _viscous(self, i: int) -> Iterator[Line]:
        """Friction linear in the speeds; for separate masses with the damping of the contact form, −γ m v."""
        model, left, per_time = self.model, self.own[i], unit_of(self.data.units[i], 0, self.time, 1)
        parts = [] if model.friction is None else [-model.friction.viscous[i]]
        if self.newton and isinstance(model.damping, LinearDamping):
            parts.append(-model.damping.rate * self._masses()[i, i])
        if model.coupling is not None:
            between = model.coupling.matrix()
            for j in (j for j in range(len(self.names)) if j != i):
                # A damper between two separate masses acts by the difference of their speeds.
                damper = self.newton and float(between[i, j].detach()) < 0
                a, b = (self.names[k] for k in sorted((i, j)))
                what, sign = (f"({a}′ − {b}′)", 1.0 if i < j else -1.0) if damper else (f"{self.names[j]}′", -1.0)
                yield Line(left, what, per_time, sign * between[i, j])
                parts += [-between[i, j]] if damper else []
        if parts:
            yield Line(left, f"{self.names[i]}′", per_time, torch.stack(parts).sum())

    def _drag(self) -> Iterator[Line]:
        """Drag of one coordinate, between two, or of a body in air, and inputs that act through the position."""
        for g, text in enumerate(self.config.drag):
            assert self.model.drag is not None
            f = parse_drag(text, self.config.angles)
            for i in (i for i in range(len(self.names)) if f.air or i in (f.on, f.of)):
                drives = f.of == i or (f.input is not None and not f.power)
                value = self.model.drag.coefficient[g] * (1.0 if drives else -f.ratio)
                words = self._sign(f.on) if f.dry else "" if f.input is None else self.data.input_labels[f.input][0]
                size = unit_of(self.data.units[i], 1 - f.a - f.b - f.c, self.time, 2 - f.b - f.c)
                size = size if f.input is None else ""
                yield Line(self.own[i], drag_in_words(f, i, self.names, words), size, value)

    def _dry(self, i: int) -> Iterator[Line]:
        """Dry friction of one coordinate; a set-valued friction force below 0 counts as 0."""
        friction, name, left = self.model.friction, self.names[i], self.own[i]
        if friction is None or not friction.dry:
            return
        unit, coulomb, excess = unit_of(self.data.units[i], 1, self.time, 2), friction.coulomb, friction.breakaway
        if friction.sticking:
            coulomb, excess = coulomb if self._dry_by_position(i) else coulomb.relu(), excess.relu()
        yield Line(left, self._sign(i), unit, -coulomb[i])
        if float(excess[i].detach()):
            width = (friction.sharpest + friction.log_stribeck.exp())[i]
            width = self.shown(width, f"the speed over which breakaway of {name} fades")
            yield Line(left, f"exp(−({name}′/{width})²) {self._sign(i)}", unit, -excess[i])

    def _dry_by_position(self, i: int) -> bool:
        """Whether a part of the dry friction of this coordinate depends on the position."""
        found = (parse_drag(text, self.config.angles) for text in self.config.drag)
        return any(f.dry and f.on == i for f in found)

    def _sign(self, i: int) -> str:
        """The direction of a speed in dry friction: sgn if set-valued, else tanh."""
        friction, name = self.model.friction, self.names[i]
        assert friction is not None
        if friction.sticking:
            return f"sgn({name}′)"
        width = self.shown(friction.widths[0][i], f"the speed below which dry friction of {name} is smooth")
        return f"tanh({name}′/{width})"

    def _inputs(self) -> Iterator[Line]:
        """Each input less the zero of its sensor, where it does not act through the position."""
        friction = self.model.friction
        for j in range(self.config.inputs):
            assert friction is not None
            zero = None if friction.input_zero is None else friction.input_zero[j]
            what = self.data.input_labels[j][0]
            if zero is not None and float(zero.detach()):
                text = self.shown(zero, f"the zero of {what}")
                what = f"({what} {f'+ {text[1:]}' if text.startswith('−') else f'− {text}'})"
            for i, left in enumerate(self.own):
                # With an action, the work of inputs is part of L.
                at, text = (left, what) if self.model.action is None else ("L", f"{what} {self.names[i]}")
                yield Line(at, text, "", friction.input_map[i, j])

    def _springs(self) -> Iterator[Line]:
        """The baseline's k (1 − cos x) + b sin x or k x²/2 + b x; x is a coordinate, with translations a difference."""
        V, n = self.model.potential, len(self.names)
        if not self.config.baseline:
            return
        k, b = V.stiffness, V.tilt
        # As features the coefficients are −k, b for an angle and k/2, b for a length.
        if baseline_is_named(self.config):
            assert V.features is not None
            own = V.features.sum.coefficient[: 2 * n].reshape(n, 2)
            k, b = own[:, 0] * own.new_tensor([-1.0 if angle else 2.0 for angle in V.angles]), own[:, 1]
        across = torch.eye(n, dtype=torch.float64) if V.across is None else V.across
        for j, ((x, w), angle) in enumerate(zip(across_in_words(across, self.names), V.angles, strict=True)):
            if x and not self.newton:
                yield from self._spring_in_L(x, w, angle, k[j], b[j])
            for i in range(n if x and self.newton else 0):
                by = float(across[j, i])
                for power, value in ((2, k[j] * (1.0 if angle else w)), (1, b[j])):
                    size = unit_of(self.data.units[i], 1 if angle else 2 - power, self.time, 2)
                    what, factor = own_term(x, angle, power, True)
                    yield Line(self.lefts[i], what, size, value * by * factor)

    def _spring_in_L(self, x: str, w: float, angle: bool, k: Tensor, b: Tensor) -> Iterator[Line]:
        """The terms of one spring in L, of w times the coordinate or difference x."""
        for power, value in ((2, k * (1.0 if angle else w**2)), (1, b * (1.0 if angle else w))):
            what, factor = own_term(x, angle, power, False)
            yield Line("L", what, "", value * factor)
        # A constant in L acts only through s.
        if angle and self.model.capabilities.carries_s:
            yield Line("L", "", "", -k)

    def _features(self) -> Iterator[Line]:
        """Features of the potential: their forces on each coordinate, or their part of L."""
        features, config = self.model.potential.features, self.config
        if features is None:
            return
        first = 2 * config.dof if baseline_is_named(config) else 0
        learned = sorted_features(config.features, config.angles)[0]
        known = sorted_features(config.known, config.angles)[0]
        for feature, value in self._numbers(features.sum, learned, known, first):
            if not self.newton:
                yield Line("L", feature_in_words(feature, self.names), "", -value)
                continue
            for i in range(len(self.names)):
                for product in feature:
                    for what, by, power in slopes(product, i, self.names):
                        unit = "" if power is None else unit_of(self.data.units[i], power, self.time, 2)
                        yield Line(self.lefts[i], what, unit, -by * value)

    @staticmethod
    def _numbers(
        combination: Combination, learned: list[Feature], known: list[Feature], first: int = 0
    ) -> Iterator[tuple[Feature, Tensor]]:
        """Each feature with its coefficient; 1 for known features, whose coefficient is part of their text.

        The coefficients of `learned` begin at place `first` of the combination.
        """
        yield from zip(learned, combination.coefficient[first:], strict=False)
        one = combination.coefficient.new_ones(())
        yield from ((feature, one) for feature in known)

    def explained(self) -> list[str]:
        """Notes that an integration of the lines needs: symbols, the law of motion, and sticking."""
        model, names = self.model, self.names
        found, config = [] if is_formula(model) else [MORE], self.config
        features = (x for text in (config.features, config.known) for x in sorted_features(text, config.angles)[0])
        if any(product.function == "radius" for feature in features for product in feature):
            found.append(f"{self.distance} = √({' + '.join(raised(name, 2) for name in names)})")
        if not self.newton:
            x, by_s = names[0], model.damping is not None
            more = f" + (∂L/∂s) ∂L/∂{x}′" if by_s else ""
            forces = f" + the force on {x}" if any(line.left != "L" for line in self.lines()) else ""
            found.append(
                f"motion: d/dt ∂L/∂{x}′ = ∂L/∂{x}{more}{forces}{', so for every coordinate' * (len(names) > 1)}"
                + ("; s′ = L" if by_s else "")
            )
        if model.friction is not None and model.friction.sticking:
            held = "where a speed is 0, it stays 0 while the factor of its sgn can balance the other forces"
            more = "; a factor that would push is 0" if any(map(self._dry_by_position, range(len(names)))) else ""
            found.append(held + more)
        return found
