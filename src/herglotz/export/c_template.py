"""From a C template to C text: conditions, names and number types.

Templates write `NAME_` for the prefix, `real` for the number type, `R(0.5)` for a constant, `SPREAD(0.0)` for one that
a variable is set to, `SIN(` for a function of <math.h>, `@KEY@` for a value and `{%if flag} … {%else} … {%end}` for
parts that only some models need. `widen` turns a template for one sample into the same code for a register of samples.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np

FUNCTIONS = ("SIN", "COS", "TANH", "ATANH", "EXPM1", "EXP", "SQRT", "FABS", "FLOOR")
WIDE = (
    "problem|terms|potential|potential_t|jet|phase|phase_features|position_features|chain|evaluate|legendre_plus|"
    "kinetic|jet_\\w+|action_unit|leapfrog|friction|increments|product|activate_\\w+|unit_\\w+|tanh|growth|log1p|"
    "\\w+_network"
)
_TOKEN = re.compile(r"\{%(if \w+|if !\w+|else|end)\}\n?")


def render(template: str, values: Mapping[str, str] | None = None, flags: Mapping[str, bool] | None = None) -> str:
    """Resolve conditions and `@KEY@`s; names and numbers are left to `finish`."""
    out: list[str] = []
    active = [True]
    position = 0
    for token in _TOKEN.finditer(template):
        out.append(template[position : token.start()] if active[-1] else "")
        position = token.end()
        word = token[1]
        if word == "end":
            active.pop()
        elif word == "else":
            active[-1] = active[-2] and not active[-1]
        else:
            flag = word.removeprefix("if ")
            value = (flags or {})[flag.removeprefix("!")] != flag.startswith("!")
            active.append(active[-1] and value)
    out.append(template[position:])
    assert len(active) == 1, "unbalanced conditions in a template"
    return fill("".join(out), values or {})


def fill(text: str, values: Mapping[str, str]) -> str:
    """Put values in for `@KEY@`s, in one pass; keys that are not given stay."""
    return re.sub(r"@(\w+)@", lambda m: values.get(m[1], m[0]), text)


def widen(text: str) -> str:
    """The same functions for a register of samples: types and functions get the prefix `wide_`, numbers are lanes.

    Constants (`static const real`) stay numbers: compilers spread them when they meet lanes.
    """
    text = re.sub(r"\bNAME_(" + WIDE + r")\b", r"NAME_wide_\1", text)
    text = re.sub(r"(?<!static const )\breal\b", "NAME_lanes", text)
    text = re.sub(r"\bSPREAD\(", "NAME_spread(", text)
    for function in FUNCTIONS:
        text = re.sub(rf"\b{function}\(", f"NAME_wide_{function.lower()}(", text)
    return text


def finish(text: str, name: str, dtype: str) -> str:
    """Put in the prefix, the number type, its constants and its functions."""
    suffix = "" if dtype == "float64" else "f"
    text = re.sub(r"\bSPREAD\(([^()]*)\)", r"R(\1)", text)
    text = re.sub(r"\bR\(([^()]*)\)", lambda m: _constant(m[1], suffix), text)
    for function in FUNCTIONS:
        text = re.sub(rf"\b{function}\(", f"{function.lower()}{suffix}(", text)
    text = re.sub(r"\breal\b", "NAME_real", text)
    return re.sub(r"\bNAME_", f"{name}_", text)


def number(value: float, dtype: str) -> str:
    """One number as a C constant that reads back exactly."""
    if dtype == "float64":
        return _constant(repr(float(value)), "")
    return _constant(f"{float(np.float32(value)):.9g}", "f")


def numbers(values: Iterable[float], dtype: str) -> str:
    """A list of constants, several a line."""
    words = [number(v, dtype) for v in values]
    lines = [", ".join(words[k : k + 5]) for k in range(0, len(words), 5)]
    return lines[0] if len(lines) == 1 else "\n  " + ",\n  ".join(lines)


def text_constant(value: str) -> str:
    """A C string constant, ASCII only."""
    plain = {ord("\\"): "\\\\", ord('"'): '\\"', ord("?"): "\\?"}
    escaped = (plain.get(b, chr(b) if 32 <= b < 127 else f"\\{b:03o}") for b in value.encode())
    return '"' + "".join(escaped) + '"'


def _constant(digits: str, suffix: str) -> str:
    if not any(mark in digits for mark in ".en"):
        digits += ".0"
    return digits + suffix
