"""Numbers in C: constants, and numbers of a model set at run time."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch

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


def constants(entries: Mapping[str, Sequence[float | None]], dtype: str) -> str:
    """The structure of the parameters, their indices, names, defaults and bounds."""
    largest = torch.finfo(getattr(torch, dtype)).max
    missing = {"defaults": 0.0, "lowest": -largest, "highest": largest}
    columns = zip(missing.items(), zip(*entries.values(), strict=True), strict=True)
    rows = {key: [none if x is None else x for x in row] for (key, none), row in columns}
    indices = ", ".join(f"hz_{identifier(name)} = {i}" for i, name in enumerate(entries))
    names = ", ".join(map(text_constant, entries))
    lines = ["/* theta.value[i] is the number with index i of this list. */", f"enum {{ {indices} }};"]
    lines += [f"typedef struct {{\n  hz_real value[{len(entries)}];\n}} hz_parameters;"]
    lines += [f"static const hz_parameters hz_{key} = {{{{{numbers(row, dtype)}}}}};" for key, row in rows.items()]
    lines += [f"static const char *const hz_parameter_names[hz_P] = {{{names}}};"]
    return "\n".join(lines) + "\n"


def identifier(name: str) -> str:
    """The name of a number in C, after the prefix."""
    return re.sub(r"\W+", "_", name).strip("_")
