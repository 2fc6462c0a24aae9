"""A model as one C99 header that steps with <math.h> alone."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from herglotz.data.files import PathLike, write_atomically
from herglotz.errors import InputError
from herglotz.export.c_api import API, BATCHES
from herglotz.export.c_arithmetic import activations, number_tests
from herglotz.export.c_batch import BATCH
from herglotz.export.c_model import activations_of, constants_source, flags_of, functions_source, legendre_plus_source
from herglotz.export.c_network import PRODUCT, WIDE_PRODUCT
from herglotz.export.c_solver import ADVANCE, ELIMINATION
from herglotz.export.c_template import fill, finish, number, numbers, render, text_constant, widen
from herglotz.export.metadata import describe
from herglotz.models import ContactLagrangian

MARK = "herglotz-metadata: "
TOLERANCE = 16  # machine epsilons; the header steps in increments, so this is within reach
MAX_ITERATIONS = 30

_TOP = """\
/* @NAME@: the time stepper of a learned contact Lagrangian. C99 (and C++11), <math.h> only, no allocation.

   Written by herglotz @VERSION@; do not edit. One step (q, p, s) -> (q1, p1, s1) solves D1 L_d + c p = 0 for q1.

   #include <stdio.h>
   #include "@FILE@"  // cc -O3 -march=native -std=c99 -ffp-contract=fast example.c -lm

   int main(void) {
     NAME_real q0[NAME_N] = {0}, q1[NAME_N] = {0}, left;
     NAME_state x;
     int k, status;
     q1[0] = (NAME_real)0.01;  // two measured positions, h apart
     status = NAME_init(q0, q1, 0, NAME_h, {%if inputs}0, {%end}&x);
     for (k = 0; k < 100 && !(status & 15); k++) {
       status = NAME_step(&x, NAME_h, {%if inputs}0, {%end}&left);
       printf("%d %g %g\\n", k, (double)x.q[0], (double)left);
     }
     if (status & 15)  // the state is the last good one
       fprintf(stderr, "step %d failed with status %d\\n", k, status);
     if (status & NAME_OUTSIDE_BOX)
       fprintf(stderr, "outside the data the model was fitted to\\n");
     return status & 15;
   }

   @MARK@@METADATA@
*/
#ifndef NAME_HEADER
#define NAME_HEADER

#include <math.h>

#ifdef __cplusplus
#define NAME_RESTRICT
#else
#define NAME_RESTRICT restrict
#endif

typedef @REAL@ NAME_real;
enum { NAME_N = @N@, NAME_M = @M@ };  /* coordinates, inputs */

/* What a step returns. */
enum {
  NAME_CONVERGED = 0,
  NAME_MAX_ITERATIONS = 1,
  NAME_SINGULAR = 2,      /* det J = 0 or c = 0: the step is not defined there */
  NAME_DIVERGED = 3,      /* a value stopped being finite */
  NAME_BAD_INPUT = 5,     /* h <= 0, or a number that is not finite */
  NAME_OUTSIDE_BOX = 16,  /* a separate bit: a state outside the box of the fitted data; the step is done */
  NAME_OUTSIDE_H = 32     /* a separate bit: h outside [NAME_h_low, NAME_h_high]; the step is done */
};

/* `status & 15` is 0 where a step succeeded; the bits above are flags.

   A state. q in NAME_units; p in the units of D2 L_d, s in those of L_d; sigma is the product of the factors c of the
   steps so far (start it at 1). */
typedef struct {
  real q[NAME_N], p[NAME_N], s, sigma;
} NAME_state;

/* What the model is. */
static const char NAME_weights_sha256[] = @SHA@;
static const char NAME_level[] = @LEVEL@;
static const char NAME_dtype[] = @DTYPE@;
static const char NAME_versions[] = @VERSIONS@;
static const char *const NAME_units[] = {@UNIT_LIST@};
static const int NAME_is_angle[NAME_N] = {@ANGLES@};
static const real NAME_h = @H@;  /* typical step: recorded, not imposed */
static const real NAME_h_low = @H_LOW@, NAME_h_high = @H_HIGH@;  /* steps it was fitted for */
static const real NAME_tolerance = @TOLERANCE@;  /* of Newton, relative to the size of q */
static const real NAME_floor = @FLOOR@;  /* rounding that no iteration removes */
static const real NAME_top_speed = @TOP_SPEED@;  /* the networks' rounding is relative to h times this, even at rest */
static const real NAME_near = R(0.01);  /* moves below this, relative, keep the last J */
enum { NAME_max_iterations = @MAX_ITERATIONS@, NAME_BOXED = @BOXED@ };
@BOX@"""


def export_c(
    model: ContactLagrangian,
    path: PathLike,
    *,
    h: float,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    name: str = "herglotz_stepper",
    dtype: str = "float64",
    h_range: tuple[float, float] | None = None,
    tolerance: float | None = None,
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Write the model's flow as one C99 header: weights inside, no dependency but <math.h>, no allocation.

    Its functions are `NAME_init` (state from two positions), `NAME_step`, `NAME_rollout` and their `_batch`es; an
    example stands at the top of the file. Compile with `-O3 -march=native` for speed; `docs/c.md` has the rest.

    Parameters
    ----------
    model
        Not changed.
    path
        The header to write, atomically; the name should end in `.h`.
    h
        Typical step of the model, in the data's time unit: recorded, not imposed.
    box
        Where the model was fitted, as in `export_pt2`; states outside it are flagged in the status.
    units
        Unit of each coordinate.
    name
        Prefix of every name in the file, a C identifier.
    dtype
        "float64" (C double) or "float32" (C float).
    h_range
        Smallest and largest step the model was fitted for: steps outside are flagged in the status. Default: that of
        the metadata, or any h > 0.
    tolerance
        Of Newton, relative to the size of q: where the model is no more exact than this, fewer iterations serve as
        well. Default: 16 machine epsilons.
    metadata
        Further JSON-ready entries for the comment at the top.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    InputError
        If an argument is not usable, a weight is not finite, or the file cannot be written.
    """
    path = Path(path)
    entries = _entries(model, h, box, units, name, dtype, h_range, tolerance, metadata or {})
    write_atomically(path, c_source(model, entries, path.name).encode())
    return path


def c_source(model: ContactLagrangian, entries: Mapping[str, Any], file: str, *, explicit: bool = True) -> str:
    """The text of the header; not `explicit` solves by Newton what needs no solving, to compare the two."""
    model = copy.deepcopy(model).double().requires_grad_(False)  # rounded once, when the numbers are written
    dtype = entries["dtype"]
    flags = {**flags_of(model), "box": entries["box"] is not None}
    flags["linear"] = flags["linear"] and explicit
    flags["stiff"] = flags["linear"] and flags["friction"]  # the matrix of the step depends on h
    versions = f"herglotz {entries['herglotz_version']}, torch {entries['torch_version']}"
    comment = json.dumps(entries, allow_nan=False).replace("*", "\\u002a").replace("?", "\\u003f")
    eps = torch.finfo(getattr(torch, dtype)).eps
    top = {
        "MARK": MARK,
        "REAL": "double" if dtype == "float64" else "float",
        "N": str(entries["dof"]),
        "M": str(entries["inputs"]),
        "SHA": text_constant(entries["weights_sha256"]),
        "LEVEL": text_constant(entries["level"]),
        "DTYPE": text_constant(dtype),
        "ANGLES": ", ".join(str(int(a)) for a in entries["angles"]),
        "H": number(entries["h"], dtype),
        "H_LOW": number((entries["h_range"] or [0.0])[0], dtype),
        "H_HIGH": number((entries["h_range"] or [torch.finfo(getattr(torch, dtype)).max])[-1], dtype),
        "BOXED": str(int(flags["box"])),
        "TOLERANCE": number(entries["newton_tolerance"], dtype),
        "FLOOR": number(1000 * eps, dtype),
        "TOP_SPEED": number(max(model.config.speed), dtype),
        "MAX_ITERATIONS": str(MAX_ITERATIONS),
        "BOX": _box_constants(entries["box"], dtype),
        "VERSIONS": text_constant(versions),
    }
    head = render(_TOP, top, flags)
    functions, names = functions_source(model, dtype, flags), activations_of(model)
    parts = [head, number_tests(dtype), constants_source(model, dtype), activations(names, dtype), PRODUCT, functions]
    parts += [legendre_plus_source(flags), render(ELIMINATION + ADVANCE, None, flags)]
    if flags["wide"]:
        parts += ["\n#ifdef NAME_LANE_BYTES", WIDE_PRODUCT, widen(functions), render(BATCH, None, flags), "#endif\n"]
    parts += [render(API + BATCHES, None, flags), "\n#undef NAME_RESTRICT\n#undef NAME_HIDDEN\n#endif\n"]
    text = finish("".join(parts), entries["name"], dtype)
    last = {
        "NAME": entries["name"],
        "VERSION": entries["herglotz_version"],
        "FILE": _plain(file),
        "UNIT_LIST": ", ".join(map(text_constant, entries["units"] or [""] * entries["dof"])),
        "METADATA": comment,
    }
    return fill(text, last)  # after `finish`, so that no user's text is taken for a template


def read_metadata(text: str, path: PathLike) -> dict[str, Any]:
    """The entries that `export_c` wrote into the comment at the top.

    Raises
    ------
    InputError
        If there are none.
    """
    found = re.search(rf"^ *{re.escape(MARK)}(.*)$", text, re.MULTILINE)
    try:
        entries = json.loads(found[1]) if found else None
    except json.JSONDecodeError:
        entries = None
    if not isinstance(entries, dict) or not {"name", "dof", "dtype", "h", "box", "angles"} <= set(entries):
        raise InputError(f"{path}: has no herglotz metadata; write it with herglotz.export.export_c")
    return entries


def _entries(
    model: ContactLagrangian,
    h: float,
    box: Mapping[str, Sequence[float]] | None,
    units: Sequence[str],
    name: str,
    dtype: str,
    h_range: tuple[float, float] | None,
    tolerance: float | None,
    extra: Mapping[str, Any],
) -> dict[str, Any]:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,40}", name):
        raise InputError(f"name must be a C identifier of at most 41 letters, digits and _, got {name!r}")
    if dtype not in ("float64", "float32"):
        raise InputError(f"dtype must be 'float64' or 'float32', got {dtype!r}")
    span = extra.get("h_range") if h_range is None else [float(x) for x in h_range]
    entries = describe(model, h, box, units, MAX_ITERATIONS, {**extra, "h_range": span})
    torch_dtype = getattr(torch, dtype)
    bad = [key for key, value in model.state_dict().items() if not bool(torch.isfinite(value.to(torch_dtype)).all())]
    if bad:
        raise InputError(f"{', '.join(bad)} hold values that are not finite in {dtype}; train the model again")
    least = TOLERANCE * torch.finfo(torch_dtype).eps
    if tolerance is not None and not least <= tolerance < 1:
        raise InputError(f"tolerance must be at least {least:.2g} in {dtype} and below 1, got {tolerance:g}")
    entries |= {"name": name, "dtype": dtype, "newton_tolerance": least if tolerance is None else tolerance}
    return entries


def _box_constants(box: Mapping[str, list[float]] | None, dtype: str) -> str:
    if box is None:
        return "/* No box was recorded. */\n"
    lines = [f"static const real NAME_{k}[NAME_N] = {{{numbers(v, dtype)}}};" for k, v in box.items() if k[0] != "s"]
    lines += [f"static const real NAME_{k} = {number(box[k][0], dtype)};" for k in ("s_low", "s_high")]
    return "/* The box the model was fitted in. */\n" + "\n".join(lines) + "\n"


def _plain(file: str) -> str:
    """A file name that can stand in a comment."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", file)
