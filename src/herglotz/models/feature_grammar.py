"""The grammar of a feature's text, and its reader.

    feature = [sign] product { sign product }
    product = factor { ["*"] factor }             at most one function of the position, and one power beside a wave
    factor  = number | ("cos" | "sin") "(" form ")" | base [ "^" integer ]
    base    = "r" | "q" index | "v" index | "(" form ")" | size
    size    = "|" "q" index "|"                   |q1|^3, and before a power of the same coordinate: |q1| q1^2
    form    = [sign] addend { sign addend }
    addend  = [ number ["*"] ] "q" index | number             a number only in a wave: cos(2.5 q1 + 0.3)

Only r takes negative powers. Odd powers of |q1| stand for sgn(q1) q1^k, k ≥ 2. Blanks only separate.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

from herglotz.errors import InputError

# If data vary by a factor of 10, their 16th power varies by 1e16: all the digits of float64.
HIGHEST_POWER = 16
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)|(?P<coordinate>[qv]\d+)|(?P<word>cos|sin|r(?![a-z]))"
    r"|(?P<mark>[-+*^()|]))"
)
HOW = "write sums of products of numbers, v1, and one of cos(q1 - q2), sin(q1), (q1 - q2)^2, q1^3, |q1| q1, r^-1"


@dataclass(frozen=True)
class Product:
    """factor · f(w·q + phase) · (a·q)^degree · ∏ v, with the forms w and a and the coordinates of the factors v.

    The `function` f is "cos", "sin", "power" (x^power), "signed" (sgn(x) x^power) or "radius" (r^power with r = |q|, no
    w). Only waves have a phase, or a lever arm (a·q)^degree: r cos θ. Factors v are repeated for powers.
    """

    factor: float
    function: str
    form: tuple[float, ...] = ()  # (n,)
    power: int = 0
    velocities: tuple[int, ...] = ()
    phase: float = 0.0
    arm: tuple[float, ...] = ()  # (n,) a, or none where the degree is 0
    degree: int = 0


Feature = tuple[Product, ...]


def parse(text: str, angles: Sequence[bool]) -> Feature:
    """The products whose sum is the feature.

    Raise InputError, with the feature and the unreadable part, if the text is no feature.
    """
    return _parsed(text, tuple(angles))


@cache
def _parsed(text: str, angles: tuple[bool, ...]) -> Feature:
    """`parse` with a memory: a search builds hundreds of models from the same terms."""
    feature = _Reader(text, angles).feature()
    if len({bool(p.velocities) for p in feature}) > 1:
        raise InputError(f"feature '{text}': some products hold velocities and some do not; write two features")
    return feature


class _Reader:
    """Recursive descent, one method for each rule of the grammar."""

    def __init__(self, text: str, angles: Sequence[bool]):
        self.text, self.angles, self.n = text, angles, len(angles)
        self.tokens: list[tuple[str, str, int]] = []  # (kind, text, start)
        at, end = 0, len(text.rstrip())
        while at < end:
            match = _TOKEN.match(text, at)
            if match is None:
                raise self._unread(at)
            kind = str(match.lastgroup)
            self.tokens.append((kind, match[kind], match.start(kind)))
            at = match.end()
        self.tokens.append(("end", "", end))
        self.at = 0

    def feature(self) -> Feature:
        """The whole text."""
        products = [self._product(self._sign() or 1.0)]
        while (sign := self._sign()) is not None:
            products.append(self._product(sign))
        if self._next()[0] != "end":
            raise self._unread(self._next()[2])
        return tuple(products)

    def _product(self, factor: float) -> Product:
        begin = self._next()[2]
        functions: list[tuple[str, tuple[float, ...], int, float]] = []
        velocities: list[int] = []
        numbers = count = 0
        more = (("mark", "("), ("mark", "|"))
        while (
            count == 0 or self._take("*") or self._next()[0] in ("number", "coordinate", "word")
            or self._next()[:2] in more
        ):  # fmt: skip
            kind, token, _ = self._next()
            if kind == "number":
                numbers += 1
                factor *= self._number()
            elif kind == "coordinate" and token[0] == "v":
                velocities += [self._coordinate()] * self._power()
            else:
                functions.append(self._function())
            if numbers > 1:
                raise self._error(f"'{self.text[begin:].strip()}' has two numbers in one product; write their product")
            count += 1
        arm, degree = (), 0
        if sorted(f[0] in ("cos", "sin") for f in functions) == [False, True]:
            functions.sort(key=lambda f: f[0] in ("cos", "sin"))
            if functions[0][0] == "power":
                _, arm, degree, _ = functions.pop(0)
        if len(functions) > 1:
            raise self._error(
                f"'{self.text[begin : self._next()[2]].strip()}' has {len(functions)} functions of the position, and a "
                "product takes one, or a power beside a wave; q1 q2 is 0.25 (q1 + q2)^2 - 0.25 (q1 - q2)^2"
            )
        function, form, power, phase = (functions or [("power", (0.0,) * self.n, 0, 0.0)])[0]
        return self._checked(Product(factor, function, form, power, tuple(velocities), phase, arm, degree))

    def _checked(self, product: Product) -> Product:
        """The product, if its function fits the coordinates."""
        radial = product.function == "radius"
        used = product.arm if product.degree else [True] * self.n if radial else product.form
        if (product.power or product.degree) and any(w and angle for w, angle in zip(used, self.angles, strict=True)):
            raise self._error("a power of an angle is not periodic; use cos or sin")
        if product.phase and product.function not in ("cos", "sin"):
            raise self._error(f"a power of q + {product.phase:g} is a sum of powers; write these, or a wave")
        if radial and product.velocities:
            raise self._error("powers of r join the potential; write the product without velocities")
        return product

    def _function(self) -> tuple[str, tuple[float, ...], int, float]:
        """The name, form, power and phase of cos, sin, or a power of a form, a coordinate or r."""
        kind, token, where = self._next()
        if token in ("cos", "sin"):
            self.at += 1
            if not self._is("("):
                raise self._unread(where)
            form, phase = self._form()
            return token, form, 0, phase
        if token == "r":
            self.at += 1
            return "radius", (), self._power(negative=True), 0.0
        if token == "(":
            form, phase = self._form()
            return "power", form, self._power(), phase
        if token == "|":
            return *self._size(), 0.0
        if kind == "coordinate":
            i = self._coordinate()
            return "power", tuple(float(i == j) for j in range(self.n)), self._power(), 0.0
        raise self._unread(where)

    def _size(self) -> tuple[str, tuple[float, ...], int]:
        """The name, form and power of |q_i|^k, times q_i^m where that follows; an even k makes a plain power."""
        begin = self._next()[2]
        self.at += 1
        if self._next()[0] != "coordinate" or self._next()[1][0] != "q":
            raise self._unread(begin)
        i = self._coordinate()
        if not self._take("|"):
            raise self._unread(begin)
        own = power = self._power()
        if self._next()[:2] == ("coordinate", f"q{i + 1}"):
            self.at += 1
            power += self._power()
        if power > HIGHEST_POWER:
            raise self._error(f"a power must be at most {HIGHEST_POWER}, got {power}")
        if power == 1:
            raise self._error(f"the force of |q{i + 1}| jumps at 0; write |q{i + 1}| q{i + 1} or |q{i + 1}|^3")
        return ("signed" if own % 2 else "power"), tuple(float(i == j) for j in range(self.n)), power

    def _form(self) -> tuple[tuple[float, ...], float]:
        """The numbers w (n,) and the constant of a linear form in parentheses."""
        begin = self._next()[2]
        self.at += 1
        w, phase = [0.0] * self.n, 0.0
        sign: float | None = self._sign() or 1.0
        while sign is not None:
            number = self._next()[0] == "number"
            if number:
                sign *= self._number()
                number = not self._take("*")
            kind, token, _ = self._next()
            if number and kind != "coordinate":
                phase, sign = phase + sign, self._sign()
                continue
            if kind != "coordinate" or token[0] != "q":
                break
            at = self._coordinate()
            w[at] += sign
            if not math.isfinite(w[at]):
                raise self._error(f"the factors of q{at + 1} add up to a number that is too large")
            sign = self._sign()
        if sign is not None or not self._take(")"):
            words = self.text[begin + 1 :].partition(")")[0]
            raise self._error(f"cannot read the linear form '{words}'; write q1 - q2 or 2*q1 + q3")
        return tuple(w), phase

    def _power(self, negative: bool = False) -> int:
        """The power after the present base; 1 without a power."""
        if not self._take("^"):
            return 1
        sign = -1 if negative and self._take("-") else 1
        kind, token, where = self._next()
        if kind != "number" or not token.isdigit():
            found = self.text[where:].split(maxsplit=1)[0] if self.text[where:].strip() else "nothing"
            below = " (only r takes negative ones)" if self._is("-") else ""
            raise self._error(f"a power must be a whole number, got '{found}'{below}")
        if len(token) > 6 or int(token) > HIGHEST_POWER:
            raise self._error(f"a power must be at most {HIGHEST_POWER}, got {token[:12]}")
        self.at += 1
        return sign * int(token)

    def _number(self) -> float:
        _, token, _ = self._next()
        self.at += 1
        value = float(token)
        if not math.isfinite(value) or (value == 0 and re.match(r"[0.]*[1-9]", token)):
            raise self._error(f"the number {token} is too {'small' if value == 0 else 'large'}")
        if self._next()[0] == "number":
            raise self._error(f"'{token}' and '{self._next()[1]}' stand side by side; write one number")
        return value

    def _coordinate(self) -> int:
        digits = self._next()[1][1:]
        if len(digits) > 6 or not 1 <= int(digits) <= self.n:
            raise self._error(f"there is no coordinate {digits}; they are numbered 1 … {self.n}")
        self.at += 1
        return int(digits) - 1

    def _sign(self) -> float | None:
        return 1.0 if self._take("+") else -1.0 if self._take("-") else None

    def _next(self) -> tuple[str, str, int]:
        return self.tokens[self.at]

    def _is(self, mark: str) -> bool:
        return self._next()[:2] == ("mark", mark)

    def _take(self, mark: str) -> bool:
        found = self._is(mark)
        self.at += found
        return found

    def _unread(self, at: int) -> InputError:
        rest = self.text[at:].strip() or self.text
        return self._error(f"cannot read '{rest}'; {HOW}")

    def _error(self, what: str) -> InputError:
        return InputError(f"feature '{self.text}': {what}")
