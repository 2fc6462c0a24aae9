"""Numbers and texts as C constants."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

CONSTANT = re.compile(r"\bR\(([^()]*)\)")


def number(value: float, dtype: str) -> str:
    """One number as a C constant that a compiler reads back exactly."""
    if dtype == "float64":
        return _decimal(repr(float(value)))
    return _decimal(f"{float(np.float32(value)):.9g}") + "f"


def numbers(values: Iterable[float], dtype: str) -> str:
    """A list of constants, several a line."""
    words = [number(v, dtype) for v in values]
    lines = [", ".join(words[k : k + 5]) for k in range(0, len(words), 5)]
    return lines[0] if len(lines) == 1 else "\n  " + ",\n  ".join(lines)


def written(text: str, dtype: str) -> str:
    """The text with the constants of emitted functions, such as `R(0.5)`, written in the number type."""
    return CONSTANT.sub(lambda m: number(float(m[1]), dtype), text)


def text_constant(value: str) -> str:
    """A C string constant, ASCII only."""
    plain = {ord("\\"): "\\\\", ord('"'): '\\"', ord("?"): "\\?"}
    escaped = (plain.get(b, chr(b) if 32 <= b < 127 else f"\\{b:03o}") for b in value.encode())
    return '"' + "".join(escaped) + '"'


def _decimal(digits: str) -> str:
    return digits if any(mark in digits for mark in ".en") else digits + ".0"
