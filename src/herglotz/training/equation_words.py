"""How an equation is worded: features and friction forces with the names of their coordinates, units, numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from herglotz.models.drag import DragFeature
from herglotz.models.feature_grammar import Product

SMALL = 1e-4  # below it a number has its power of ten: more than four zeros are not counted at a glance
RELATIVE = 1e-12  # smaller deviations are rounding
_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def drag_in_words(f: DragFeature, i: int, names: Sequence[str]) -> str:
    """A friction force on coordinate i with the names of its coordinates."""
    if f.air:
        return f"√({' + '.join(f'{name}′²' for name in names)}) {names[i]}′"
    speed = f"{names[f.on]}′" if f.of is None else f"({names[f.on]}′ − {names[f.of]}′)"
    position, size = [raised(names[f.at], f.a)] if f.a else [], [f"|{speed.strip('()')}|"] if f.b else []
    if f.dry:
        return f"{f'{f.wave}({names[f.at]})' if f.wave else position[0]} sgn({speed})"
    return " ".join([*position, *size, *([raised(speed, f.c)] if f.c else [])])


def slope(p: Product, i: int, names: Sequence[str]) -> tuple[str, float, int]:
    """∂/∂q_i of a product without velocities: its text, its factor, and the power of length in the unit of a force."""
    if p.function == "radius":
        return f"{raised('r', p.power - 2)} {names[i]}".strip(), p.factor * p.power, 2 - p.power
    form, w = _form(p.form, names), p.form[i]
    if p.function == "power":
        inner = form if sum(1 for x in p.form if x) == 1 else f"({form})"
        return (raised(inner, p.power - 1) if p.power > 1 else ""), p.factor * p.power * w, 2 - p.power
    if p.function == "signed":
        return f"|{form}| {raised(form, p.power - 2)}".strip(), p.factor * p.power * w, 2 - p.power
    return (f"sin({form})", -p.factor * w, 1) if p.function == "cos" else (f"cos({form})", p.factor * w, 1)


def _form(form: tuple[float, ...], names: Sequence[str]) -> str:
    parts = [(w, name) for w, name in zip(form, names, strict=True) if w]
    text = " ".join(f"{'−' if w < 0 else '+'} {'' if abs(w) == 1 else f'{abs(w):g} '}{name}" for w, name in parts)
    return text.removeprefix("+ ")


def feature_in_words(text: str, names: Sequence[str]) -> str:
    """A feature's text with the names of the coordinates."""
    text = re.sub(r"(?<![\d.])1(?=q)", "", text).replace("-", "−").replace("*", " ")
    text = re.sub(r"([qv])(\d+)", lambda x: names[int(x[2]) - 1] + ("′" if x[1] == "v" else ""), text)
    return f"({text})" if " − " in text and "(" not in text else text  # x y′ − y x′ has one coefficient


def raised(base: str, power: int) -> str:
    """x³ of x and 3; nothing of a power of 0."""
    return base if power == 1 else "" if power == 0 else base + str(power).translate(_RAISED)


def unit_of(unit: str, power: int, time: str, per: int) -> str:
    """Power of the coordinate's unit over a power of the unit of time."""
    top = "" if unit == "1" else raised(unit, power)
    bottom = "" if time == "1" or not per else f"{time}{str(per).translate(_RAISED) if per > 1 else ''}"
    return (f"{top or '1'}/{bottom}" if bottom else top) or "1"


def number(value: float, deviation: float | None) -> str:
    """A value with its standard deviation in units of its last digit: 25.0(3), and 4.7(2)e-8 of small ones."""
    if deviation is None or not math.isfinite(deviation) or deviation <= RELATIVE * value:
        return f"{value:.4g}"
    if 0 < (size := max(value, deviation)) < SMALL:
        power = math.floor(math.log10(size))
        return f"{number(value / 10.0**power, deviation / 10.0**power)}e{power}"
    digits = -math.floor(math.log10(deviation))
    last = round(deviation * 10.0**digits)
    digits, last = (digits + 1, round(deviation * 10.0 ** (digits + 1))) if last == 1 else (digits, last)
    if digits > 12 or digits < -6:
        return f"{value:.6g} ± {deviation:.1g}"
    return (
        f"{value:.{digits}f}({last})" if digits > 0 else f"{round(value, digits):.0f}({round(deviation, digits):.0f})"
    )
