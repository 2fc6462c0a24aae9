"""Text of an equation: features and friction forces with the names of coordinates, units, and numbers.

Standard deviations and digits of numbers come from the joint posterior of all parameters.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.models import ContactLagrangian
from herglotz.models.drag import DragFeature
from herglotz.models.features import Feature, Product
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.trades import Trade, combinations, joined

# Numbers outside this range are printed with a power of ten, because many zeros are hard to count.
SMALL, LARGE = 1e-4, 1e7
# Digits of a number that the user gave: all but rounding errors.
EXACT = 10
# Digits of a number if its influence on the motion is unknown.
UNKNOWN = 7
# Digits of a number beside a network: without a formula of the network nobody integrates the lines.
BESIDE = 4
# A deviation of this many units of the last digit is printed with ±, because brackets of three digits are hard to read.
LAST = 100
# Relative length. If the part of a number's derivative outside the span of others is shorter, it depends on the others.
DEPENDENT = 1e-9
_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def own_term(name: str, angle: bool, power: int, newton: bool) -> tuple[str, float]:
    """Text and factor of a term of the potential k (1 − cos q) + b sin q, or k q²/2 + b q: its force, or its part of L.

    `power` 2 is the term of k, 1 the term of b.
    """
    if newton:
        return (f"sin {name}" if power == 2 else f"cos {name}") if angle else (name if power == 2 else ""), -1.0
    if angle:
        return (f"cos {name}", 1.0) if power == 2 else (f"sin {name}", -1.0)
    return raised(name, power), -0.5 if power == 2 else -1.0


def drag_in_words(f: DragFeature, i: int, names: Sequence[str], given: str = "") -> str:
    """A force on coordinate i with the names of coordinates; `given` is the text of a direction, or of an input."""
    if f.air:
        return f"√({' + '.join(f'{name}′²' for name in names)}) {names[i]}′"
    ratio = "" if f.ratio == 1 else f"{plain(f.ratio)} "
    speed = f"{names[f.on]}′" if f.of is None else f"({ratio}{names[f.on]}′ − {names[f.of]}′)"
    position, size = [raised(names[f.at], f.a)] if f.a else [], [f"|{speed.strip('()')}|"] if f.b else []
    if f.wave:
        own = "" if f.rate == 1 else f"{plain(f.rate)} "
        form = names[f.at] if not f.of_speed else speed if f.of is None else speed[1:-1].replace("− ", f"− {own}")
        position = [f"{f.wave}({own}{form})"]
    if f.dry:
        return f"{position[0]} {given}"
    if f.input is not None:
        return f"{raised(given, f.power)} {speed}" if f.power else f"{given} {position[0]}"
    return " ".join([*position, *size, *([raised(speed, f.c)] if f.c else [])])


def slopes(p: Product, i: int, names: Sequence[str]) -> Iterator[tuple[str, float, int | None]]:
    """∂/∂q_i of a product without velocities: texts, factors, and the powers of length in the units of the forces.

    The factors of a product with a lever arm have units of several coordinates, and no power (None).
    """
    if p.degree and p.arm[i]:
        text = f"{raised(_inner(p.arm, names), p.degree - 1)} {_product(replace(p, degree=0), names)}".strip()
        yield text, p.factor * p.degree * p.arm[i], None
    if p.function == "radius" or p.form[i]:
        text, factor, power = _slope(p, i, names)
        yield (text, factor, power) if not p.degree else (f"{_arm(p, names)} {text}", factor, None)


def _slope(p: Product, i: int, names: Sequence[str]) -> tuple[str, float, int]:
    """∂/∂q_i of the function of a product, beside its lever arm."""
    if p.function == "radius":
        return f"{raised(distance(names), p.power - 2)} {names[i]}".strip(), p.factor * p.power, 2 - p.power
    form, w = _form(p.form, names, p.phase), p.form[i]
    if p.function == "power":
        return raised(_inner(p.form, names), p.power - 1), p.factor * p.power * w, 2 - p.power
    if p.function == "signed":
        return f"|{form}| {raised(_inner(p.form, names), p.power - 2)}".strip(), p.factor * p.power * w, 2 - p.power
    return (f"sin({form})", -p.factor * w, 1) if p.function == "cos" else (f"cos({form})", p.factor * w, 1)


def distance(names: Sequence[str]) -> str:
    """The symbol of the distance |q|, which is no name of a coordinate."""
    return "ρ" if "r" in names else "r"


def _form(form: tuple[float, ...], names: Sequence[str], phase: float = 0.0) -> str:
    parts = [(w, name) for w, name in zip(form, names, strict=True) if w]
    text = " ".join(f"{'−' if w < 0 else '+'} {'' if abs(w) == 1 else f'{plain(abs(w))} '}{name}" for w, name in parts)
    text += f" {'−' if phase < 0 else '+'} {plain(abs(phase))}" if phase else ""
    return text.removeprefix("+ ")


def _inner(form: tuple[float, ...], names: Sequence[str]) -> str:
    """A form as the base of a power: in brackets unless it is a single name."""
    text = _form(form, names)
    return text if text in names else f"({text})"


def feature_in_words(feature: Feature, names: Sequence[str]) -> str:
    """A feature with the names of the coordinates; a sum such as x y′ − y x′ stands in brackets."""
    texts = [(p.factor, _product(p, names)) for p in feature]
    if len(texts) == 1 and texts[0][0] == 1:
        return texts[0][1]
    sizes = [(factor < 0, text if abs(factor) == 1 and text else f"{plain(abs(factor))} {text}".rstrip())
             for factor, text in texts]  # fmt: skip
    joined = " ".join(f"{'−' if minus else '+'} {text}" for minus, text in sizes).removeprefix("+ ")
    return f"({joined})"


def _product(p: Product, names: Sequence[str]) -> str:
    """A product without its factor; "" for a constant."""
    speeds = [raised(f"{names[i]}′", p.velocities.count(i)) for i in dict.fromkeys(p.velocities)]
    if p.function == "radius":
        return raised(distance(names), p.power)
    form = _form(p.form, names, p.phase)
    if p.function in ("cos", "sin"):
        return " ".join([*([_arm(p, names)] if p.degree else []), f"{p.function}({form})", *speeds])
    power = p.power - (p.function == "signed")
    own = [f"|{form}|"] if p.function == "signed" else []
    return " ".join([*own, *([raised(_inner(p.form, names), power)] if power and form else []), *speeds])


def _arm(p: Product, names: Sequence[str]) -> str:
    """The lever arm of a product."""
    return raised(_inner(p.arm, names), p.degree)


def raised(base: str, power: int) -> str:
    """Base and exponent, x³; "" for a power of 0."""
    return base if power == 1 else "" if power == 0 else base + str(power).translate(_RAISED)


def unit_of(unit: str, power: int, time: str, per: int) -> str:
    """A power of the coordinate's unit over a power of the unit of time."""
    top = "" if unit == "1" else raised(unit, power)
    bottom = "" if time == "1" or not per else f"{time}{str(per).translate(_RAISED) if per > 1 else ''}"
    return (f"{top or '1'}/{bottom}" if bottom else top) or "1"


def plain(value: float, digits: int = EXACT) -> str:
    """A number without a deviation, with a minus sign in place of a hyphen."""
    return f"{value:.{digits}g}".replace("-", "−", int(value < 0))


def number(value: float, deviation: float | None, alone: float | None, digits: int = UNKNOWN) -> str:
    """A value ≥ 0 with its standard deviation: 25.0(3), 2.955(±4.1), 4.7(2)e-8.

    The value is rounded to a digit below `alone`, its deviation with all other numbers fixed: correlated numbers are
    known together far better than one by one, but rounding changes one at a time. The deviation is printed in units of
    the last digit, or with ±.
    """
    if alone is None or not 0 < alone < math.inf:
        return plain(value, digits)
    if not SMALL <= max(value, alone) < LARGE:
        power = math.floor(math.log10(max(value, alone)))
        size = 10.0**power
        return f"{number(value / size, None if deviation is None else deviation / size, alone / size)}e{power}"
    places = max(0, -math.floor(math.log10(alone)))
    text = f"{value:.{places}f}"
    if deviation is None or not math.isfinite(deviation):
        return text
    last = round(deviation * 10.0**places)
    if last >= LAST:
        return f"{text}(±{plain(float(f'{deviation:.2g}'))})"
    return f"{text}({last})" if last else text


@dataclass(frozen=True)
class Joint:
    """The posterior of a model's P numbers (`herglotz.training.laplace`).

    `alone` are standard deviations with all other unknowns fixed; `information` is the inverse covariance by the data
    without the prior, marginal over the start states.
    """

    covariance: Tensor  # (P, P)
    alone: Tensor  # (P,)
    information: Tensor  # (P, P)


class Numbers:
    """Value, deviation and conditional deviation of numbers that are functions of a model's parameters.

    With y = g·θ to first order the deviation of y is √(gᵀ C g). Rounding changes y alone, and the motion by no more
    than if one of its parameters took the change. The parameter with the largest effect on the motion sets the digits.
    """

    def __init__(self, model: ContactLagrangian, joint: Joint | None, digits: int = UNKNOWN):
        self.joint, self.digits, self.named = joint, digits, dict(model.named_parameters())
        self.at = {entry: k for k, entry in enumerate(ParameterVector(model).entries)}
        # Derivatives of every number, by its words.
        self.slopes: dict[str, dict[int, float]] = {}

    def known(self, value: Tensor, words: str) -> tuple[float, float | None, float | None]:
        """The value, its deviation, and the deviation that sets its digits; None if unknown.

        `words` name the number in `trades`; "": the number is no part of `trades`.
        """
        slopes, joint = self._slopes(value), self.joint
        if joint is None or not slopes:
            return float(value.detach()), None, None
        if words:
            self.slopes[words] = slopes
        at, g = torch.tensor(list(slopes)), joint.covariance.new_tensor(list(slopes.values()))
        deviation = math.sqrt(max(0.0, float(g @ joint.covariance[at][:, at] @ g)))
        by = g.abs() * joint.alone[at]
        # The derivative by a parameter that cancels, such as a common mass, is a rounding error.
        alone = float(by[by >= DEPENDENT * by.max()].min())
        finite = math.isfinite(deviation)
        return float(value.detach()), deviation if finite else None, alone if math.isfinite(alone) else None

    def _slopes(self, value: Tensor) -> dict[int, float]:
        """Derivatives of a number that are not 0, by the place of the parameter in the vector."""
        if not value.requires_grad or self.joint is None:
            return {}
        found = torch.autograd.grad(value, list(self.named.values()), allow_unused=True, retain_graph=True)
        slopes = {}
        for name, slope in zip(self.named, found, strict=True):
            rows = () if slope is None else slope.reshape(-1).tolist()
            slopes |= {self.at[name, i]: x for i, x in enumerate(rows) if x and (name, i) in self.at}
        return slopes

    def shown(self, value: Tensor, words: str, bracketed: bool = False) -> str:
        """The text of a number inside a term, with its deviation in brackets or without."""
        x, deviation, alone = self.known(value, words)
        return ("−" if x < 0 else "") + number(abs(x), deviation if bracketed else None, alone, self.digits)

    def trades(self) -> list[Trade]:
        """Combinations of the printed numbers that the data do not determine; overlapping ones are joined.

        A combination of parameters that leaves every printed number unchanged, two rates in one number, is none.
        """
        if self.joint is None or not self.slopes:
            return []
        M = self.joint.information
        # Parameters over `size`, and numbers over the length of `row`, have no unit.
        size = torch.where(M.diagonal() > 0, M.diagonal(), 1.0).sqrt()
        rows, names, basis = [], [], M.new_zeros(0, len(M))
        for words, slopes in self.slopes.items():
            row = M.new_zeros(len(M))
            row[list(slopes)] = row.new_tensor(list(slopes.values()))
            row = row / size
            row = new = row / row.norm()
            # Gram–Schmidt twice, against rounding.
            for _ in range(2):
                new = new - basis.T @ (basis @ new)
            if float(new.norm()) > DEPENDENT:
                rows, names, basis = [*rows, row], [*names, words], torch.cat([basis, (new / new.norm())[None]])
        back = torch.linalg.pinv(torch.stack(rows))  # (P, K)
        B = back.T @ (M / size[:, None] / size) @ back
        return joined(combinations(B, B.diagonal(), names))
