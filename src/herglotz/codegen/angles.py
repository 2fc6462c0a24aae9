"""Sines and cosines of sums of angles by the addition theorems: four products in place of calls of 15 to 30 ns each.

An angle is a linear form of numbers of a program, or of products of two numbers, such as a rate and a coordinate. A
Fourier series, whose angles are multiples of a single angle, costs a single sine and a single cosine; rounding grows by
half a unit in the last place with each multiple.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from herglotz.codegen.program import Atom, Program, Ref

# Digits to which the coefficients of equal angles agree: float64 has 15, and multiples round the last two.
DIGITS = 13

# A product of at most two numbers of a program, sorted; () is 1.
Monomial = tuple[Ref, ...]
# Coefficients of the monomials of an angle.
Form = dict[Monomial, float]


class Angle(NamedTuple):
    """A form with sorted terms and a positive first coefficient, and the sign that was divided out."""

    form: tuple[tuple[Monomial, float], ...]
    sign: float


class Angles:
    """The angles of a program whose sines and cosines are known."""

    def __init__(self, program: Program):
        self.program = program
        self.known: dict[tuple[tuple[Monomial, float], ...], tuple[Atom, Atom]] = {}
        self._forms: dict[Ref, Form] = {}

    def waves(self, atom: Ref) -> tuple[Atom, Atom]:
        """The sine and the cosine of a number."""
        angle = _normal(self._form(atom))
        if angle.form not in self.known:
            found = self._sum(angle.form)
            if found is None:
                sine = self.program.scalar("FN_sin({0})", (atom,))
                cosine = self.program.scalar("FN_cos({0})", (atom,))
                found = self._signed(angle.sign, sine), cosine
            self.known[angle.form] = found
        sine, cosine = self.known[angle.form]
        return self._signed(angle.sign, sine), cosine

    def _sum(self, form: tuple[tuple[Monomial, float], ...]) -> tuple[Atom, Atom] | None:
        """sin(a + b) = sin a cos b + cos a sin b and cos(a + b) of two known angles of this sum, else None."""
        scalar = self.program.scalar
        times = lambda x, y: scalar("{0} * {1}", (x, y))  # noqa: E731
        for first, (sin_a, cos_a) in self.known.items():
            rest = _normal(_combined(dict(form), dict(first), -1.0))
            if rest.form in self.known:
                sin_b, cos_b = self.known[rest.form]
                sin_b = self._signed(rest.sign, sin_b)
                sine = scalar("{0} + {1}", (times(sin_a, cos_b), times(cos_a, sin_b)))
                return sine, scalar("{0} - {1}", (times(cos_a, cos_b), times(sin_a, sin_b)))
        return None

    def _signed(self, sign: float, atom: Atom) -> Atom:
        return atom if sign > 0 else self.program.scalar("-{0}", (atom,))

    def _form(self, atom: Any) -> Form:
        """A number as a form in other numbers."""
        if not isinstance(atom, Ref):
            return {(): float(atom)}
        if atom not in self._forms:
            self._forms[atom] = self._expanded(atom)
        return self._forms[atom]

    def _expanded(self, atom: Ref) -> Form:
        operation, *parts = self.program.operations.get(atom, ("",))
        if operation in ("{0} + {1}", "{0} - {1}"):
            return _combined(self._form(parts[0]), self._form(parts[1]), 1.0 if "+" in operation else -1.0)
        if operation == "-{0}":
            return _combined({}, self._form(parts[0]), -1.0)
        if operation == "{0} * {1}" and (product := _product(*map(self._form, parts))) is not None:
            return product
        if operation == "{0} / {1}" and not isinstance(parts[1], Ref):
            return _combined({}, self._form(parts[0]), 1.0 / float(parts[1]))
        return {(atom,): 1.0}


def _combined(a: Form, b: Form, by: float) -> Form:
    """The form a + by b."""
    return {key: a.get(key, 0.0) + by * b.get(key, 0.0) for key in {**a, **b}}


def _product(a: Form, b: Form) -> Form | None:
    """The product of two forms, of which one has a single monomial; None if more than two numbers are multiplied."""
    if len(b) == 1:
        a, b = b, a
    if len(a) != 1 or any(len(x) + len(y) > 2 for x in a for y in b):
        return None
    ((x, by),) = a.items()
    return {tuple(sorted(x + y)): by * value for y, value in b.items()}


def _normal(form: Form) -> Angle:
    """A form as an angle, its coefficients rounded to `DIGITS`."""
    rounded = {key: float(f"{x:.{DIGITS - 1}e}") for key, x in form.items()}
    most = max(map(abs, rounded.values()), default=0.0)
    kept = [(key, x) for key, x in rounded.items() if abs(x) > most * 10.0**-DIGITS]
    kept.sort(key=lambda term: (not term[0], term))
    sign = -1.0 if kept and kept[0][1] < 0 else 1.0
    return Angle(tuple((key, sign * x) for key, x in kept), sign)
