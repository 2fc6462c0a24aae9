"""A model compiled as C and loaded: `hz.compile`, with the eager stepper where C is impossible, and `compile_c`."""

from __future__ import annotations

import copy
import os
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from herglotz.codegen.c_compiler import compiler
from herglotz.data.files import PathLike
from herglotz.errors import InputError
from herglotz.export.c_header import c_source, described
from herglotz.export.exported import ExportedStepper
from herglotz.export.load import compiled, load_c
from herglotz.export.metadata import describe
from herglotz.export.parameters import Chosen, described_parameters
from herglotz.export.step import MAX_ITERATIONS
from herglotz.models import ContactLagrangian, OwnLagrangian
from herglotz.stepping import Stepper

# The models that can be traced.
MODELS = (ContactLagrangian, OwnLagrangian)


def compile(
    source: Stepper | ContactLagrangian | PathLike | Any, *, trust_code: bool = False
) -> ExportedStepper | Stepper:
    """A stepper with the interface of `Stepper` that steps in C, without derivatives.

    The library is kept in ~/.cache/herglotz/c by the hash of the model. Without a C compiler, or for a model that has
    no C, the result is the eager stepper, and a warning says what is missing.

    Parameters
    ----------
    source
        A model, a `Stepper` of one, a run (its h, box and units are recorded), or a header that `export_c` wrote.
    trust_code
        As in `load_c`, for a header.

    Returns
    -------
    ExportedStepper or Stepper
        The eager stepper where C is not possible.

    Raises
    ------
    InputError
        If the source is none of these, or a header cannot be compiled: a header has no eager stepper to fall back on.
    """
    if isinstance(source, str | os.PathLike):
        return load_c(source, trust_code=trust_code)
    eager = source if isinstance(source, Stepper) else None
    # A run has its model as an attribute.
    run: Any = source
    own = source if isinstance(source, MODELS) else getattr(source, "model", None)
    model: Any = own if eager is None else eager.L_d
    if not isinstance(model, MODELS):
        if eager is None:
            given = type(source).__name__
            raise InputError(f"compile needs a model, a Stepper, a run or the path of a C header, got {given}")
        return _fall_back(eager, f"{type(model).__name__} is no ContactLagrangian and has no C form")
    of_run: dict[str, Any] = {} if eager or model is run else {"h": run.h, "box": run.box, "units": run.data.units}
    eager = eager or Stepper(model)
    if eager.throw:
        return _fall_back(eager, "throw=True needs the eager stepper")
    try:
        compiler()
        return compile_c(model, **of_run)
    except InputError as error:
        return _fall_back(eager, str(error))


def _fall_back(eager: Stepper, reason: str) -> Stepper:
    warnings.warn(f"hz.compile: stepping in PyTorch instead of C: {reason}", RuntimeWarning, stacklevel=3)
    return eager


def compile_c(
    model: Any,
    *,
    h: float = 1.0,
    box: Mapping[str, Sequence[float]] | None = None,
    units: Sequence[str] = (),
    dtype: str | None = None,
    tolerance: float | None = None,
    parameters: Chosen = (),
) -> ExportedStepper:
    """Compile a model's C and load it; `load_c` compiles a header.

    The library is kept in ~/.cache/herglotz/c (or $XDG_CACHE_HOME) by the hash of its source, the compiler and the
    processor. The compiler is $CC, or cc, gcc or clang from the PATH.

    The model, a ContactLagrangian or OwnLagrangian, is not changed. The other arguments are those of `export_c`; dtype
    defaults to the model's. The result is a drop-in for `Stepper`, and its `with_parameters` sets parameters. Raise
    InputError if no compiler is installed, or an argument is not usable.
    """
    given: object = model
    if not isinstance(given, MODELS):
        raise InputError(f"compile_c takes a model, got {type(given).__name__}; load_c opens a header")
    dtype = dtype or str(next(model.parameters()).dtype).removeprefix("torch.")
    extra = {"parameters": described_parameters(model, parameters)} if parameters else {}
    entries = describe(model, h, box, units, MAX_ITERATIONS, {"h_range": None, **extra})
    entries = described(model, entries, "model", dtype, tolerance)
    # A copy, because training may change the model before `whole` is called.
    kept: Any = copy.deepcopy(model)
    header = c_source(kept, entries, "stepper.h", derivatives=False)
    return compiled(header, "compiled model", lambda: c_source(kept, entries, "stepper.h"))
