"""Grey-box features: functions of (q, v) that a user names as text, with learned or known coefficients.

A feature without velocities joins the potential V, a feature with velocities the kinetic term K. A feature is a sum of
products, each of at most one function of the position, a power beside a wave, and any number of velocities:

    cos(q1 - q2) v1 v2        (q2 - q1)^4 + (q3 - q2)^4        0.5 r^-1        q1 v2 - q2 v1        q1 cos(q2)

The functions are cos, sin and whole powers of a linear form of the q, whole powers of r = |q|, and |q1| q1 or |q1|^3
of a length: |q1| q1 has the force |q1| of a spring that is stiffer on one side. One coefficient multiplies the whole
sum, so that the products share a parameter. Short names stand for lists of features (`LIBRARIES`).

The grammar of a feature's text is

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
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from inspect import signature
from itertools import combinations, combinations_with_replacement, permutations, product

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
        used = product.arm if product.degree else [1.0] * self.n if radial else product.form
        # A turn of all joints together leaves differences of angles as they are.
        if (product.power or product.degree) and sum(w for w, angle in zip(used, self.angles, strict=True) if angle):
            raise self._error("a power of an angle is not periodic; use cos or sin, or a difference (q1 - q2)^2")
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


def expand(names: Sequence[str], angles: Sequence[bool]) -> list[str]:
    """The features with every library name replaced by the features of that library, each feature once."""
    out: list[str] = []
    for name in names:
        word, _, argument = name.partition(" ")
        library = LIBRARIES.get(word)
        if library is None:
            out.append(name)
        elif argument and len(signature(library).parameters) == 1:
            raise InputError(f"feature '{name}': this library takes no number; write '{word}'")
        elif argument and not argument.strip().isdigit():
            raise InputError(f"feature '{name}': this library takes one whole number, as '{word} 2' does")
        else:
            out += library(angles, *([int(argument)] if argument else []))
    return list(dict.fromkeys(out))


def chain(angles: Sequence[bool], highest: int = 4) -> list[str]:
    """Equal springs between neighbours and to both walls: powers 2 … `highest` of the stretches."""
    n = len(angles)
    stretches = ["(q1)", *(f"(q{i + 1} - q{i})" for i in range(1, n)), f"(-q{n})"]
    return [" + ".join(f"{s}^{power}" for s in stretches) for power in range(2, highest + 1)]


def sites(angles: Sequence[bool], highest: int = 4) -> list[str]:
    """Equal springs from every coordinate to a wall: powers 1 … `highest`."""
    coordinates = range(1, len(angles) + 1)
    return [" + ".join(f"q{i}^{power}" for i in coordinates) for power in range(1, highest + 1)]


# Every library has the argument `angles`.
def central(angles: Sequence[bool], highest: int = 3) -> list[str]:  # noqa: ARG001
    """A potential of the distance r = |q|: powers −`highest` … `highest`."""
    return [f"r^{k}" for k in range(-highest, highest + 1) if k]


def pendulums(angles: Sequence[bool]) -> list[str]:
    """Links in a plane with absolute angles: cos(q_i − q_j) couples each pair of speeds."""
    return [f"cos(q{i + 1} - q{j + 1}) v{i + 1} v{j + 1}" for i, j in combinations(range(len(angles)), 2)]


def harmonics(angles: Sequence[bool], highest: int = 2) -> list[str]:
    """Waves cos and sin of k·q, Σ|k_i| ≤ `highest`, of the angles: in the potential and in every entry of the mass."""
    return _waves(angles, highest, highest)


def revolute(angles: Sequence[bool]) -> list[str]:
    """Waves cos and sin of k·q with every |k_i| ≤ 1, in the potential and in every entry of the mass.

    The library is exact for every chain of links in a plane, with absolute angles or angles between neighbours.
    """
    return _waves(angles, 1, len(angles))


def spherical(angles: Sequence[bool]) -> list[str]:
    """Joints q_j that turn about an axis across that of another joint q_i: the mass of q_i has cos 2q_j.

    A link with the angle q_j to the axis of q_i, as a spherical or a rotary pendulum has, adds m l² sin² q_j v_i²/2 to
    K.
    """
    turning = [i for i, angle in enumerate(angles, 1) if angle]
    return [f"cos(2q{j}) v{i} v{i}" for i, j in permutations(turning, 2)]


def windings(angles: Sequence[bool]) -> list[str]:
    """Torsion springs between two joints, which may turn together without end: motor and load, a flexible joint."""
    turning = [i for i, angle in enumerate(angles, 1) if angle]
    return [f"(q{i} - q{j})^2" for i, j in combinations(turning, 2)]


def lengths(angles: Sequence[bool]) -> list[str]:
    """Frequent features of coordinates that are no angles, singly and in pairs.

    Powers 2, 3 and 4 of each difference of two, 3 and 4 of each coordinate. For two or three coordinates also powers 3
    and 4 of sums, a potential of the distance r = |q|, and forces across the velocity (a magnetic field, a rotating
    frame). The baseline already has r².
    """
    n = len(angles)
    pairs = [(i + 1, j + 1) for i, j in combinations(range(n), 2)]
    names = [f"(q{i} - q{j})^{power}" for power in (2, 3, 4) for i, j in pairs]
    names += [f"q{i + 1}^{power}" for power in (3, 4) for i in range(n)]
    if 1 < n <= 3:
        names += [f"(q{i} + q{j})^{power}" for power in (3, 4) for i, j in pairs]
        names += [name for name in central(angles) if name != "r^2"]
        names += [f"q{i} v{j} - q{j} v{i}" for i, j in pairs]
    return names


def slides(angles: Sequence[bool]) -> list[str]:
    """Slides q_i that joints q_j turn: weight, the mass of the joint, and masses between the joint and other speeds.

    A mass m at the distance q_i on a link with the angle q_j adds m q_i² v_j²/2 to K and m g q_i cos q_j to V; terms of
    the first power of q_i say where its zero is.
    """
    coordinates = range(1, len(angles) + 1)
    names = []
    for i, j in product((i for i in coordinates if not angles[i - 1]), (j for j in coordinates if angles[j - 1])):
        names += [f"q{i} cos(q{j})", f"q{i} sin(q{j})", f"q{i} v{j}^2", f"q{i}^2 v{j}^2"]
        names += [f"q{i} {f}(q{j}) v{j} v{k}" for k in coordinates if k not in (i, j) for f in ("cos", "sin")]
    return names


def _waves(angles: Sequence[bool], highest: int, total: int) -> list[str]:
    """The waves of k·q with |k_i| ≤ highest and Σ|k_i| ≤ total, without the baseline's cos qᵢ and sin qᵢ in V."""
    which = [i for i, angle in enumerate(angles, 1) if angle]
    numbers = product(range(-highest, highest + 1), repeat=len(which))
    forms = [_form(k, which) for k in numbers if 0 < sum(map(abs, k)) <= total and k > (0,) * len(k)]
    baseline = [f"q{i}" for i in which]
    pairs = [f"v{i} v{j}" for i, j in combinations_with_replacement(range(1, len(angles) + 1), 2)]
    waves = [f"{f}({form})" for form in forms for f in ("cos", "sin")]
    alone = [f"{f}({form})" for form in forms if form not in baseline for f in ("cos", "sin")]
    return alone + [f"{wave} {pair}" for pair in pairs for wave in waves]


def _form(k: Sequence[int], which: Sequence[int]) -> str:
    """k·q of the coordinates `which`, as text."""
    numbers = {1: "", -1: "-"}
    return " + ".join(f"{numbers.get(x, x)}q{i}" for x, i in zip(k, which, strict=True) if x).replace("+ -", "- ")


LIBRARIES: dict[str, Callable[..., list[str]]] = {
    "chain": chain,
    "sites": sites,
    "central": central,
    "pendulums": pendulums,
    "harmonics": harmonics,
    "revolute": revolute,
    "slides": slides,
    "spherical": spherical,
    "windings": windings,
    "lengths": lengths,
}
