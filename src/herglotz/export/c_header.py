"""A model as one C99 header that steps with <math.h> alone."""

from __future__ import annotations

import copy
import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch

from herglotz.codegen.program import as_scalars
from herglotz.data.files import PathLike, sealed_text, write_trusted
from herglotz.data.holds import Arrival
from herglotz.errors import InputError
from herglotz.export.equation import Equations
from herglotz.export.lower.c import StepInC, as_lanes, with_zero_as_input
from herglotz.export.metadata import EXTRAS, check_metadata, describe, from_json, input_labels
from herglotz.export.parameters import Chosen, described_parameters, moved_numbers, with_moved_numbers
from herglotz.export.step import MAX_ITERATIONS, ROUNDING_EPSILONS
from herglotz.models import ContactLagrangian

MARK = "herglotz-metadata: "
# A constant of an emitted function.
CONSTANT = re.compile(r"\bR\(([^()]*)\)")
# The prefix of the names in a header.
NAME = r"[A-Za-z][A-Za-z0-9_]{0,40}"
# Newton's default tolerance in machine epsilons of q, which a step in increments reaches.
TOLERANCE = 16
# Coordinates: the elimination of a step's derivative is written out, and its length grows with their cube.
MAX_DERIVATIVES = 8
# Coordinates: the n x n matrices of more, one number a sample in each register, are larger than the stack of some
# threads.
MAX_WIDE = 24

TOP = """\
/* hz_: the time stepper of a learned contact Lagrangian. C99 (and C++11), <math.h> only, no allocation.

   Written by herglotz {version}; do not edit. One step (q, p, s) -> (q1, p1, s1) solves D1 L_d + c p = 0 for q1.

   #include <stdio.h>
{arrival}   #include "{file}"  // cc -O3 -march=native -std=c99 -ffp-contract=fast example.c -lm

   int main(void) {{
     hz_state x = hz_start;  // or your own: hz_init_qv makes a state of a position and a velocity
     hz_real left;
{own_u}     int k, status = 0;
     for (k = 0; k < 100 && !(status & 15); k++) {{
       status = hz_step(&x, hz_h, {u}&left);
       printf("%d %g %g\\n", k, (double)x.q[0], (double)left);
     }}
     if (status & 15)  // the state is the last good one
       fprintf(stderr, "step %d failed with status %d\\n", k, status);
     if (status & hz_OUTSIDE_BOX)
       fprintf(stderr, "outside the data the model was fitted to\\n");
     return status & 15;
   }}

   {mark}{comment}
*/
#ifdef hz_HEADER
#if hz_HEADER != {guard}
#error "two different models have the prefix hz_: export one of them under another name (--name)"
#endif
#else
#define hz_HEADER {guard}

#include <math.h>

/* Sizes and kinds of the model, for the preprocessor. */
#define hz_N {n} /* coordinates */
#define hz_M {m} /* inputs */
#define hz_INPUTS {inputs} /* numbers that a step takes of the inputs: these, and 1 where these have a zero */
#define hz_P {parameters} /* numbers that are set at run time */
#define hz_SINGLE {single} /* float, not double */
#define hz_EXPLICIT {explicit} /* the step equation is linear in q1: no iteration */
#define hz_STICKING {sticking} /* dry friction can hold a coordinate still */
#define hz_BOXED {boxed} /* a box of the fitted data is recorded */
#define hz_CARRIES_S {carries_s} /* the motion depends on s */
#define hz_DERIVATIVES {derivatives} /* the header has hz_step_jacobian */
#define hz_WIDE {wide} /* batches are stepped by registers of samples */

typedef {real} hz_real;
"""
CONSTANTS = """
/* The model. */
static const char hz_weights_sha256[] = {sha};
static const char hz_level[] = {level};
static const char hz_dtype[] = {dtype};
static const char hz_versions[] = {versions};
static const char *const hz_units[] = {{{units}}};
static const int hz_is_angle[hz_N] = {{{angles}}};
static const hz_real hz_h = {h}; /* typical step{in_unit}: recorded, not imposed */
static const hz_real hz_h_low = {h_low}, hz_h_high = {h_high}; /* steps of the fit and of the recording{in_unit} */
static const hz_real hz_tolerance = {tolerance}; /* of Newton, relative to the size of q */
static const hz_real hz_floor = {floor}; /* rounding that no iteration removes */
static const hz_real hz_top_speed = {top_speed}; /* the networks' rounding is relative to h times this, even at rest */
static const hz_real hz_near = {near}; /* moves below this, relative, keep the last J */
enum {{ hz_max_iterations = {max_iterations} }};
{box}{start}"""
# The files of the runtime in every header; `step.h` and `run.h` are texts of `REAL` and `FN_`, like the emitted
# functions.
RUNTIME = (
    "types.h", "numbers.h", "parameters.h", "functions.h", "elementary.h", "products.h", "checks.h", "step.h", "run.h",
    "api.h",
)  # fmt: skip


def export_c(
    model: ContactLagrangian,
    path: PathLike,
    *,
    h: float,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    name: str | None = None,
    dtype: str = "float64",
    h_range: tuple[float, float] | None = None,
    tolerance: float | None = None,
    parameters: Chosen = (),
    extras: Sequence[str] = (),
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Write the model's flow as one C99 header: weights inside, no dependency but <math.h>, no allocation.

    Its functions are `NAME_init` (state from two positions), `NAME_init_qv` (from a position and a velocity),
    `NAME_velocity`, `NAME_step`, `NAME_step_jacobian`, `NAME_rollout` and the `_batch`es; an example stands at the top
    of the file. Compile with `-O3 -march=native` for speed; `docs/c.md` has the rest.

    Parameters
    ----------
    model, path, h, box, units, metadata
        As in `export_pt2`. The name of the file should end in `.h`. The status flags states outside the box; the
        comment at the top has the metadata.
    name
        Prefix of every name in the file, a C identifier; default: the file's name. Headers of different prefixes can
        be included in one program.
    dtype
        "float64" (C double) or "float32" (C float).
    h_range
        Smallest and largest step that the model was fitted for: the status flags other steps. Default: `h_range` of
        the metadata, or any h > 0.
    tolerance
        Newton's tolerance, relative to the size of q; fewer iterations are enough for a model that is less exact than
        this. Default: 16 machine epsilons.
    parameters
        Numbers of the model that are set at run time, in the model's own units: names as in `numbers_of`, also those
        of several numbers (`friction.viscous`), or names with (low, high), None without a bound. Their values in the
        model are the defaults.
    extras
        Further functions: "adjoint" (`NAME_step_vjp`, `NAME_rollout_vjp`), "filter" (`NAME_filter_…`).

    Returns
    -------
    Path
        The file written.

    Raise InputError if an argument is not usable, a weight is not finite, or the file cannot be written.
    """
    path = Path(path)
    name = identifier(path.stem) if name is None else name
    extra = dict(metadata or {})
    extra["h_range"] = extra.get("h_range") if h_range is None else [float(x) for x in h_range]
    if parameters:
        extra["parameters"] = described_parameters(model, parameters)
        extra |= moved_numbers(model, extra["parameters"])
    if extras:
        _check_extras(extras, model.dof)
        extra["extras"] = list(extras)
    entries = described(model, describe(model, h, box, units, MAX_ITERATIONS, extra), name, dtype, tolerance)
    check_metadata(entries, path)
    return write_trusted(path, sealed_text(c_source(model, entries, path.name)).encode())


def c_source(model: ContactLagrangian, entries: Mapping[str, Any], file: str, *, derivatives: bool = True) -> str:
    """The text of the header.

    Without `derivatives` NAME_step_jacobian, NAME_init_qv and NAME_velocity are left out: they take most of the time
    of an export. NAME_step_jacobian is left out beyond 8 coordinates, too.
    """
    velocities, derivatives = derivatives, derivatives and entries["dof"] <= MAX_DERIVATIVES
    chosen = {name: value for name, (value, *_) in entries.get("parameters", {}).items()}
    model = with_moved_numbers(model, entries)
    # In float64: numbers are rounded once, when they are written.
    step = StepInC(Equations.of(with_zero_as_input(copy.deepcopy(model).double()), chosen))
    parameters = _parameters(entries["parameters"], entries["dtype"]) if chosen else ""
    inverse = (resources.files("herglotz.codegen") / "runtime" / "inverse.h").read_text(encoding="utf-8")
    types, number_tests, of_parameters, functions, elementary, products, checks, *loops, api = map(runtime, RUNTIME)
    one_step = step.source() + "\n".join(loops)
    slopes = (step.slopes() if derivatives else "") + (step.pull() if "adjoint" in entries.get("extras", ()) else "")
    momentum = step.momentum() if velocities else ""
    parts = [_top(model, entries, step, derivatives), types, _constants(model, entries), number_tests, parameters]
    parts += [of_parameters, functions, as_scalars(elementary), "#ifdef hz_LANE_BYTES", as_lanes(elementary), "#endif"]
    parts += [as_scalars(inverse), products, step.tables(), checks, as_scalars(one_step)]
    parts += ["#ifdef hz_BATCHED", as_lanes(one_step), "#endif"] if entries["dof"] <= MAX_WIDE else []
    parts += [as_scalars(slopes), api]
    if velocities:
        parts += [as_scalars(momentum), "#ifdef hz_BATCHED", as_lanes(momentum), "#endif"]
        parts += [as_lanes(runtime("velocity.h"))]
    parts += [*_extras_source(entries), "#undef hz_RESTRICT\n#undef hz_HIDDEN\n#endif\n"]
    text = re.sub(r"\bhz_", f"{entries['name']}_", written("\n".join(parts), entries["dtype"]))
    comment = json.dumps(entries, allow_nan=False).replace("*", "\\u002a").replace("?", "\\u003f")
    last = {
        "METADATA": comment,
        "FILE": re.sub(r"[^A-Za-z0-9_.-]", "_", file),
        "UNITS": ", ".join(map(text_constant, entries["units"] or [""] * entries["dof"])),
        "INPUTS": _in_comment(", ".join(f"{name} [{unit or '-'}]" for name, unit in input_labels(entries))),
    }
    # A user's texts are put in last, so that no replacement above changes them.
    return re.sub(r"@(\w+)@", lambda m: last.get(m[1], m[0]), text)


def runtime(file: str) -> str:
    """The text of a file of the C runtime, which is package data."""
    return resources.files("herglotz.export").joinpath("runtime", file).read_text(encoding="utf-8")


def _check_extras(extras: object, dof: int) -> None:
    """Refuse unknown extras, and a filter of more than `MAX_DERIVATIVES` coordinates."""
    unknown = [x for x in extras if x not in EXTRAS] if isinstance(extras, list | tuple) else [extras]
    if unknown:
        raise InputError(f"extras may be {', '.join(EXTRAS)}, got {unknown[0]!r}; name them as a list")
    if "filter" in extras and dof > MAX_DERIVATIVES:  # pyright: ignore[reportOperatorIssue]
        raise InputError(
            f"a filter in C needs the derivative of a step, up to {MAX_DERIVATIVES} coordinates; this has {dof}"
        )


def _extras_source(entries: Mapping[str, Any]) -> list[str]:
    """The texts of the extras that a header's metadata names."""
    found = []
    for name in entries.get("extras", ()):
        found += [runtime(f"{name}.h")]
        if name == "filter" and (noise := entries.get("noise")):
            rows = [noise["position"], noise["momentum"]]
            rows += [noise["theta"]] if entries.get("parameters") else []
            values = ", ".join(f"{{{numbers(row, entries['dtype'])}}}" for row in rows)
            values += f", {number(noise['adaptation'], entries['dtype'])}"
            found += [f"/* The noise of the fit. */\nstatic const hz_noise hz_noise_of_fit = {{{values}}};\n"]
    return found


def read_metadata(text: str, path: PathLike) -> dict[str, Any]:
    """The entries that `export_c` wrote into the comment at the top.

    Raise InputError if the text has no entries, or impossible ones.
    """
    found = re.search(rf"^ *{re.escape(MARK)}(.*)$", text, re.MULTILINE)
    entries = from_json(found and found[1], path)
    if not re.fullmatch(NAME, entries.get("name", "")):
        raise InputError(f"{path}: metadata: name must be a C identifier, got {entries.get('name')!r}; export it again")
    return entries


def described(
    model: ContactLagrangian, entries: dict[str, Any], name: str, dtype: str, tolerance: float | None
) -> dict[str, Any]:
    """The entries of any file with the checked entries of C: name, dtype and newton_tolerance."""
    if not re.fullmatch(NAME, name):
        raise InputError(f"name must be a C identifier of at most 41 letters, digits and _, got {name!r}")
    if dtype not in ("float64", "float32"):
        raise InputError(f"dtype must be 'float64' or 'float32', got {dtype!r}")
    torch_dtype = getattr(torch, dtype)
    bad = [key for key, value in model.state_dict().items() if not bool(torch.isfinite(value.to(torch_dtype)).all())]
    if bad:
        raise InputError(f"{', '.join(bad)} hold values that are not finite in {dtype}; train the model again")
    least = TOLERANCE * torch.finfo(torch_dtype).eps
    if tolerance is not None and not least <= tolerance < 1:
        raise InputError(f"tolerance must be at least {least:.2g} in {dtype} and below 1, got {tolerance:g}")
    return entries | {"name": name, "dtype": dtype, "newton_tolerance": least if tolerance is None else tolerance}


def identifier(stem: str) -> str:
    """A C identifier from the name of a file."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", stem)[:41]
    return name if re.match("[A-Za-z]", name) else f"model_{name}"[:41]


def _time_unit(entries: Mapping[str, Any]) -> str:
    """The unit of h, without asterisks, which could end the comment."""
    return entries.get("time_unit", "s").replace("*", "")


def _arrival(entries: Mapping[str, Any]) -> str:
    """How recorded inputs are delayed or filtered before a step takes them; empty where they act at once."""
    delay, lag = Arrival(**entries.get("arrival", {})).late
    if not delay and not lag:
        return ""
    unit = _time_unit(entries)
    late = f"u(t - {delay:.6g} {unit})" if delay else "u(t)"
    formula = f"T u_f' = {late} - u_f with T = {lag:.6g} {unit}" if lag else f"u_f(t) = {late}"
    formula += ";\n   the fit took u for constant before the first sample: there u_f = u" if lag else ""
    return f"   Inputs u act late: give each step the mean over it of u_f,\n   {formula}.\n\n"


def _own_inputs(entries: Mapping[str, Any]) -> str:
    """The line of the example that sets the caller's inputs, here to the middle of the fitted range; "" without any."""
    if not entries["inputs"]:
        return ""
    ends = (entries.get(name) or entries["input_zero"] for name in ("input_low", "input_high"))
    middle = [float(f"{(low + high) / 2:.3g}") for low, high in zip(*ends, strict=True)]
    values = numbers(middle, entries["dtype"])
    return f"     hz_real u[hz_M] = {{{values}}};  // your inputs, set for each step: @INPUTS@\n"


def _in_comment(text: str) -> str:
    """A text without characters that could end a comment of C, or go on with it on the next line."""
    return re.sub(r"[^A-Za-z0-9_.,()\[\] '/^|+-]", "_", text)


def _top(model: ContactLagrangian, entries: Mapping[str, Any], step: StepInC, derivatives: bool) -> str:
    """The comment at the top, the include guard, and sizes and kinds for the preprocessor."""
    inputs = entries["inputs"]
    return TOP.format(
        version=entries["herglotz_version"],
        file="@FILE@",
        own_u=_own_inputs(entries),
        u="u, " * (inputs > 0) + "0, " * ("parameters" in entries),
        arrival=_arrival(entries),
        mark=MARK,
        comment="@METADATA@",
        guard=f"0x{hashlib.sha256(json.dumps(entries).encode()).hexdigest()[:8]}u",
        n=entries["dof"],
        m=inputs,
        inputs=step.m,
        parameters=len(entries.get("parameters", ())),
        single=int(entries["dtype"] == "float32"),
        explicit=int(step.explicit),
        sticking=int(step.sticks),
        boxed=int(entries["box"] is not None),
        carries_s=int(model.s_enters_motion),
        derivatives=int(derivatives),
        wide=int(entries["dof"] <= MAX_WIDE),
        real="float" if entries["dtype"] == "float32" else "double",
    )


def _constants(model: ContactLagrangian, entries: Mapping[str, Any]) -> str:
    """The constants of the model: digest, units, steps, tolerances, box and start."""
    dtype = entries["dtype"]
    info = torch.finfo(getattr(torch, dtype))
    span = entries["h_range"] or (0.0, info.max)
    return CONSTANTS.format(
        sha=text_constant(entries["weights_sha256"]),
        level=text_constant(entries["level"]),
        dtype=text_constant(dtype),
        versions=text_constant(f"herglotz {entries['herglotz_version']}, torch {entries['torch_version']}"),
        units="@UNITS@",
        angles=", ".join(str(int(a)) for a in entries["angles"]),
        h=number(entries["h"], dtype),
        in_unit=f" in {_time_unit(entries)}" if "time_unit" in entries else "",
        h_low=number(span[0], dtype),
        h_high=number(span[-1], dtype),
        tolerance=number(entries["newton_tolerance"], dtype),
        floor=number(ROUNDING_EPSILONS * info.eps, dtype),
        top_speed=number(max(model.config.speed), dtype),
        near=number(0.01, dtype),
        max_iterations=MAX_ITERATIONS,
        box=_box_constants(entries["box"], dtype),
        start=_start_constant(entries, dtype),
    )


def _box_constants(box: Mapping[str, list[float]] | None, dtype: str) -> str:
    if box is None:
        return "/* No box was recorded. */\n"
    lines = [f"static const hz_real hz_{k}[hz_N] = {{{numbers(v, dtype)}}};" for k, v in box.items() if k[0] != "s"]
    lines += [f"static const hz_real hz_{k} = {number(box[k][0], dtype)};" for k in ("s_low", "s_high")]
    return "/* The box the model was fitted in. */\n" + "\n".join(lines) + "\n"


def _start_constant(entries: Mapping[str, Any], dtype: str) -> str:
    """A state to start from: the start of the metadata, or rest at zero."""
    start, n = entries.get("start"), entries["dof"]
    q, p, s = (start[key] for key in "qps") if start else ([0.0] * n, [0.0] * n, 0.0)
    where = "where the fitted samples end" if start else "at rest, as no recording was given"
    values = f"{{{numbers(q, dtype)}}}, {{{numbers(p, dtype)}}}, {number(s, dtype)}, 1"
    return f"/* A state to start from: {where}. */\nstatic const hz_state hz_start = {{{values}}};\n"


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


def _parameters(entries: Mapping[str, Sequence[float | None]], dtype: str) -> str:
    """The structure of the parameters, their indices, names, defaults and bounds."""
    largest = torch.finfo(getattr(torch, dtype)).max
    missing = {"defaults": 0.0, "lowest": -largest, "highest": largest}
    columns = zip(missing.items(), zip(*entries.values(), strict=True), strict=True)
    rows = {key: [none if x is None else x for x in row] for (key, none), row in columns}
    words = (re.sub(r"\W+", "_", name).strip("_") for name in entries)
    indices = ", ".join(f"hz_{word} = {i}" for i, word in enumerate(words))
    names = ", ".join(map(text_constant, entries))
    lines = ["/* theta.value[i] is the number with index i of this list. */", f"enum {{ {indices} }};"]
    lines += [f"typedef struct {{\n  hz_real value[{len(entries)}];\n}} hz_parameters;"]
    lines += [f"static const hz_parameters hz_{key} = {{{{{numbers(row, dtype)}}}}};" for key, row in rows.items()]
    lines += [f"static const char *const hz_parameter_names[hz_P] = {{{names}}};"]
    return "\n".join(lines) + "\n"
