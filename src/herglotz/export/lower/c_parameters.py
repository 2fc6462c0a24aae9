"""Numbers in C: constants, and numbers of a model set at run time, with the forces of inputs that they determine."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from herglotz.codegen.c_function import as_scalars, whole
from herglotz.codegen.trace import traced
from herglotz.export.equation import Equations, dense, example
from herglotz.export.lower.c import interpreted
from herglotz.models import ContactLagrangian, refuse_own
from herglotz.stepping.linearise import forward_slopes

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


MARKED = re.compile(r"#if hz_P\b[^\n]*\n(?:.*?)(?:#else\n(.*?))?#endif /\* hz_P \*/\n", re.DOTALL)
TOKENS = re.compile(r"hz_TAKES_THETA |hz_WITH_THETA\([^()]*\) | \+ hz_P\b")


def without_parameters(text: str) -> str:
    """A text of the runtime for a header without parameters, with no trace of parameters left."""
    return TOKENS.sub("", MARKED.sub(lambda m: m[1] or "", text))


def constants(entries: Mapping[str, Sequence[float | None]], dtype: str) -> str:
    """The structure of the parameters, their indices, names, defaults and bounds."""
    largest = torch.finfo(getattr(torch, dtype)).max
    missing = {"defaults": 0.0, "lowest": -largest, "highest": largest}
    columns = zip(missing.items(), zip(*entries.values(), strict=True), strict=True)
    rows = {key: [none if x is None else x for x in row] for (key, none), row in columns}
    indices = ", ".join(f"hz_{identifier(name)} = {i}" for i, name in enumerate(entries))
    names = ", ".join(map(text_constant, entries))
    lines = [f"#define hz_P {len(entries)} /* numbers that are set at run time */"]
    lines += ["/* theta.value[i] is the number with index i of this list. */", f"enum {{ {indices} }};"]
    lines += [f"typedef struct {{\n  hz_real value[{len(entries)}];\n}} hz_parameters;"]
    lines += [f"static const hz_parameters hz_{key} = {{{{{numbers(row, dtype)}}}}};" for key, row in rows.items()]
    lines += [f"static const char *const hz_parameter_names[hz_P] = {{{names}}};"]
    return "\n".join(lines) + "\n"


def identifier(name: str) -> str:
    """The name of a number in C, after the prefix."""
    return re.sub(r"\W+", "_", name).strip("_")


def inputs_constants(model: ContactLagrangian, dtype: str) -> str:
    """The matrix and the offset of what a step takes of the inputs; empty without inputs."""
    if not model.config.inputs:
        return ""
    map_, offset = (numbers(x.detach().cpu().double().reshape(-1).tolist(), dtype) for x in _taken(model))
    lines = ["/* Inputs u act as input_map u + input_offset. */"]
    lines.append(f"static const hz_real hz_input_map[hz_INPUTS * hz_M] = {{{map_}}};")
    return "\n".join([*lines, f"static const hz_real hz_input_offset[hz_INPUTS] = {{{offset}}};\n"])


def _taken(model: ContactLagrangian) -> tuple[Tensor, Tensor]:
    """G and −G u₀, below 1 and 0 where inputs act through the position; 1 and 0 for an L_d that takes u itself."""
    friction, m = model.friction, model.config.inputs
    if friction is None:
        return torch.eye(m), torch.zeros(m)
    G, offset = friction.input_map, friction.offset()
    if not model.capabilities.inputs_by_position:
        return G, offset
    return torch.cat([torch.eye(m).to(G), G]), torch.cat([offset.new_zeros(m), offset])


def inputs_source(model: ContactLagrangian, values: Mapping[str, float], tables: dict[tuple[float, ...], str]) -> str:
    """The matrix and the offset of what a step takes of the inputs, and its derivative by θ, as functions of θ."""
    if not model.inputs:
        return ""
    equations = Equations.of(model, values)
    refuse_own(model, "a header whose numbers are set at run time, with inputs,", "leave parameters out")
    friction = equations.model.friction
    # A model with inputs is a forced one.
    assert friction is not None

    def forces(u: Tensor) -> tuple[Tensor, ...]:
        shared = _taken(equations.model)
        own = [u] if equations.model.capabilities.inputs_by_position else []
        return *(x.expand(len(u), *x.shape) for x in shared), torch.cat([*own, friction.applied(u)], -1)

    at = equations.of_numbers(forces)

    def parts(u: Tensor, theta: Tensor) -> tuple[Tensor, ...]:
        by_theta = forward_slopes(lambda theta: at(u, theta)[2], theta)
        return tuple(map(dense, (*at(u, theta)[:2], by_theta)))

    graph = traced(parts, (example(equations.model, 0.1)[-1], *equations.theta))
    program, arrays = interpreted(graph, {"u": model.inputs, "theta": len(values)}, tables)
    G, offset, by_theta = (list(x.ravel()) for x in arrays)
    return as_scalars(
        whole(program, INPUTS_AT, {"map": G, "offset": offset}) + whole(program, PUSH_SLOPES, {"slopes": by_theta})
    )


INPUTS_AT = """
/* A step takes map u + offset of inputs u. */
static inline void FN_inputs_at(const REAL theta[hz_P], REAL map[hz_INPUTS * hz_M], REAL offset[hz_INPUTS])"""
PUSH_SLOPES = """
/* The derivatives of what a step takes of u by theta, row by row. */
static inline void FN_push_slopes(const REAL *u, const REAL theta[hz_P], REAL slopes[hz_INPUTS * hz_P])"""
