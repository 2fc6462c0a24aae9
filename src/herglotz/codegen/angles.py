"""Sines and cosines of sums of angles by the addition theorems: four products for a call of 15 to 30 ns.

An angle is a linear form of numbers of a program. The waves of a function, whose angles are multiples of one, cost a
sine and a cosine together; rounding grows by half a unit in the last place with each multiple.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from herglotz.codegen.program import Atom, Program, Ref

DIGITS = 13  # of the coefficients of angles that are the same: multiples are rounded in the last two


class Angle(NamedTuple):
    """A linear form whose first coefficient is positive, and the sign of the one that was asked for."""

    form: tuple[tuple[Any, float], ...]  # numbers with their coefficients; that of None is the constant
    sign: float


class Angles:
    """The angles of a program whose sines and cosines are known."""

    def __init__(self, program: Program):
        self.program = program
        self.known: dict[tuple[tuple[Any, float], ...], tuple[Atom, Atom]] = {}
        self._linear: dict[Ref, dict[Any, float]] = {}

    def waves(self, atom: Ref) -> tuple[Atom, Atom]:
        """The sine and the cosine of a number."""
        angle = _normal(self.linear(atom))
        if angle.form not in self.known:
            found = self._sum(angle.form)
            if found is None:
                sine = self.program.scalar("FN_sin({0})", (atom,))
                cosine = self.program.scalar("FN_cos({0})", (atom,))
                found = self._signed(angle.sign, sine), cosine
            self.known[angle.form] = found
        sine, cosine = self.known[angle.form]
        return self._signed(angle.sign, sine), cosine

    def _sum(self, form: tuple[tuple[Any, float], ...]) -> tuple[Atom, Atom] | None:
        """sin(a + b) = sin a cos b + cos a sin b and cos(a + b) of two known angles, if they make up this one."""
        program, wanted = self.program, dict(form)
        for first, (sine, cosine) in self.known.items():
            rest = _normal({key: wanted.get(key, 0.0) - dict(first).get(key, 0.0) for key in {*wanted, *dict(first)}})
            if rest.form in self.known:
                other, by = self.known[rest.form]
                other = self._signed(rest.sign, other)
                times = lambda a, b: program.scalar("{0} * {1}", (a, b))  # noqa: E731
                plus = program.scalar("{0} + {1}", (times(sine, by), times(cosine, other)))
                return plus, program.scalar("{0} - {1}", (times(cosine, by), times(sine, other)))
        return None

    def _signed(self, sign: float, atom: Atom) -> Atom:
        return atom if sign > 0 else self.program.scalar("-{0}", (atom,))

    def linear(self, atom: Any) -> dict[Any, float]:
        """The coefficients of the numbers that a number is a linear form of; that of None is the constant."""
        if not isinstance(atom, Ref):
            return {None: float(atom)}
        if atom not in self._linear:
            self._linear[atom] = self._expanded(atom)
        return self._linear[atom]

    def _expanded(self, atom: Ref) -> dict[Any, float]:
        form, *parts = self.program.operations.get(atom, ("",))
        numbers = [part for part in parts if not isinstance(part, Ref)]
        if form in ("{0} + {1}", "{0} - {1}"):
            return _combined(self.linear(parts[0]), self.linear(parts[1]), 1.0 if "+" in form else -1.0)
        if form == "-{0}":
            return _combined({}, self.linear(parts[0]), -1.0)
        if form == "{0} * {1}" and numbers:
            other = parts[0] if isinstance(parts[0], Ref) else parts[1]
            return _combined({}, self.linear(other), float(numbers[0]))
        if form == "{0} / {1}" and not isinstance(parts[1], Ref):
            return _combined({}, self.linear(parts[0]), 1.0 / float(parts[1]))
        return {atom: 1.0}


def _combined(a: dict[Any, float], b: dict[Any, float], by: float) -> dict[Any, float]:
    """The linear form a + by b."""
    return {key: a.get(key, 0.0) + by * b.get(key, 0.0) for key in {**a, **b}}


def _normal(form: dict[Any, float]) -> Angle:
    """An angle by its coefficients in one order, rounded."""
    rounded = {key: float(f"{x:.{DIGITS - 1}e}") for key, x in form.items()}
    most = max(map(abs, rounded.values()), default=0.0)
    kept = [(key, x) for key, x in rounded.items() if abs(x) > most * 10.0**-DIGITS]
    kept.sort(key=lambda pair: (pair[0] is None, pair[0] or ()))
    sign = -1.0 if kept and kept[0][1] < 0 else 1.0
    return Angle(tuple((key, sign * x) for key, x in kept), sign)
