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
from herglotz.export.c_api import API
from herglotz.export.c_model import flags_of, terms_source
from herglotz.export.c_solver import ADVANCE, ELIMINATION
from herglotz.export.c_template import fill, finish, number, numbers, render, text_constant
from herglotz.export.pt2 import _metadata
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
     status = NAME_init(q0, q1, 0, NAME_h, &x);
     for (k = 0; k < 100 && !(status & 15); k++) {
       status = NAME_step(&x, NAME_h, &left);
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

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0
#error "compile without -ffast-math or -ffinite-math-only: they remove the checks for NaN"
#endif
#ifdef __cplusplus
#define NAME_RESTRICT
#else
#define NAME_RESTRICT restrict
#endif

typedef @REAL@ NAME_real;
enum { NAME_N = @N@ };  /* coordinates */

/* What a step returns. */
enum {
  NAME_CONVERGED = 0,
  NAME_MAX_ITERATIONS = 1,
  NAME_SINGULAR = 2,      /* det J = 0 or c = 0: the step is not defined there */
  NAME_DIVERGED = 3,      /* a value stopped being finite */
  NAME_BAD_INPUT = 5,     /* h <= 0, or a number that is not finite */
  NAME_OUTSIDE_BOX = 16   /* a separate bit: a state outside the box of the fitted data; the step is done */
};

/* A state. q in NAME_units; p in the units of D2 L_d, s in those of L_d; sigma is the product of the factors c of the
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
static const real NAME_tolerance = @TOLERANCE@;  /* of Newton, relative to the size of q */
static const real NAME_floor = @FLOOR@;  /* rounding that no iteration removes */
static const real NAME_near = R(0.01);  /* moves below this, relative, keep the last J */
enum { NAME_max_iterations = @MAX_ITERATIONS@ };
@BOX@
static inline int NAME_finite(real x) { return x - x == R(0.0); }

/* The largest |x_i|; NaN where one is NaN. */
static inline real NAME_length(const real x[NAME_N]) {
  real size = R(0.0);
  int i;
  for (i = 0; i < NAME_N; i++) {
    real a = FABS(x[i]);
    if (a > size || a != a) size = a;
  }
  return size;
}
"""


def export_c(
    model: ContactLagrangian,
    path: PathLike,
    *,
    h: float,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    name: str = "herglotz_stepper",
    dtype: str = "float64",
    metadata: Mapping[str, Any] | None = None,
) -> Path:
    """Write the model's flow as one C99 header: weights inside, no dependency but <math.h>, no allocation.

    Its functions are `NAME_init` (state from two positions), `NAME_step` and `NAME_rollout`; an example stands at the
    top of the file. Compile with `-O3 -march=native` for speed, never with `-ffast-math`.

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
    entries = _entries(model, h, box, units, name, dtype, metadata or {})
    write_atomically(path, c_source(model, entries, path.name).encode())
    return path


def c_source(model: ContactLagrangian, entries: Mapping[str, Any], file: str) -> str:
    """The text of the header."""
    model = copy.deepcopy(model).double().requires_grad_(False)  # rounded once, when the numbers are written
    dtype = entries["dtype"]
    flags = {**flags_of(model), "box": entries["box"] is not None}
    versions = f"herglotz {entries['herglotz_version']}, torch {entries['torch_version']}"
    comment = json.dumps(entries, allow_nan=False).replace("*", "\\u002a").replace("?", "\\u003f")
    eps = torch.finfo(getattr(torch, dtype)).eps
    top = {
        "MARK": MARK,
        "REAL": "double" if dtype == "float64" else "float",
        "N": str(entries["dof"]),
        "SHA": text_constant(entries["weights_sha256"]),
        "LEVEL": text_constant(entries["level"]),
        "DTYPE": text_constant(dtype),
        "ANGLES": ", ".join(str(int(a)) for a in entries["angles"]),
        "H": number(entries["h"], dtype),
        "TOLERANCE": number(entries["newton_tolerance"], dtype),
        "FLOOR": number(1000 * eps, dtype),
        "MAX_ITERATIONS": str(MAX_ITERATIONS),
        "BOX": _box_constants(entries["box"], dtype),
        "VERSIONS": text_constant(versions),
    }
    head = render(_TOP, top)
    body = render(ELIMINATION + ADVANCE + API, None, flags)
    tail = "\n#undef NAME_RESTRICT\n#endif\n"
    text = finish(head + terms_source(model, dtype) + body + tail, entries["name"], dtype)
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
    extra: Mapping[str, Any],
) -> dict[str, Any]:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,40}", name):
        raise InputError(f"name must be a C identifier of at most 41 letters, digits and _, got {name!r}")
    if dtype not in ("float64", "float32"):
        raise InputError(f"dtype must be 'float64' or 'float32', got {dtype!r}")
    entries = _metadata(model, h, box, units, 2, extra)
    torch_dtype = getattr(torch, dtype)
    bad = [key for key, value in model.state_dict().items() if not bool(torch.isfinite(value.to(torch_dtype)).all())]
    if bad:
        raise InputError(f"{', '.join(bad)} hold values that are not finite in {dtype}; train the model again")
    del entries["newton_iterations"]
    entries |= {"name": name, "dtype": dtype, "newton_tolerance": TOLERANCE * torch.finfo(torch_dtype).eps}
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
