"""The C form of a `KickStepper`: its map, traced like the step of a model, as a short header."""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from herglotz.codegen.c_compiler import build
from herglotz.codegen.c_function import as_scalars, whole
from herglotz.codegen.interpret import interpret
from herglotz.codegen.program import Program
from herglotz.codegen.trace import example_batch, traced
from herglotz.data.files import PathLike, write_atomically
from herglotz.errors import InputError
from herglotz.export.c_numbers import number, written
from herglotz.mechanics.contact import join
from herglotz.stepping import Rollout, Status
from herglotz.tune.kick_composition import KickStepper

TYPES = {"float64": "double", "float32": "float"}
HEADER = """/* One step of h = {h}: {kicks} kicks and drifts. Written by herglotz; C99, no dependency but <tgmath.h>.
   The state is (q, p, s). */
#ifndef HERGLOTZ_KICKS_H
#define HERGLOTZ_KICKS_H
#include <tgmath.h>
typedef {real} herglotz_real;
typedef struct {{ herglotz_real q, p, s; }} herglotz_kicks_state;
#define HERGLOTZ_KICKS_H_STEP {h}
#define HERGLOTZ_KICKS_FACTOR {c}

{step}
#endif
"""
LOOPS = Path(__file__).with_name("kicks.c")


def kicks_c(stepper: KickStepper, dtype: str = "float64") -> str:
    """The header for numbers of a dtype; raise InputError if the dtype has no C form."""
    if dtype not in TYPES:
        raise InputError(f"dtype must be float64 or float32, got {dtype}")
    q, p, s = torch.linspace(-1, 1, 3 * example_batch(set(stepper.cosines.shape)), dtype=torch.float64).chunk(3)
    program, places = Program(), ("x->q", "x->p", "x->s")
    given = [program.given(place, 0) for place in places]
    found = interpret(program, traced(stepper.map, (q, p, s)), given)
    outputs = {place: y.ravel()[0] for place, y in zip(places, found, strict=True)}
    step = as_scalars(whole(program, "static inline void herglotz_kicks_step(herglotz_kicks_state *x)", outputs))
    # The functions without their prefix are those of <tgmath.h>.
    step = re.sub(r"\bhz_", "", step.replace("hz_real", "herglotz_real"))
    h, c = (number(x, dtype) for x in (stepper.h, math.exp(-stepper.rate * stepper.h)))
    return HEADER.format(h=h, kicks=stepper.kicks, real=TYPES[dtype], c=c, step=written(step, dtype))


def export_kicks_c(stepper: KickStepper, path: PathLike, dtype: str = "float64") -> Path:
    """Write the header."""
    path = Path(path)
    write_atomically(path, kicks_c(stepper, dtype).encode())
    return path


class CompiledKicks:
    """A `KickStepper` compiled: `rollout` as there."""

    def __init__(self, stepper: KickStepper, dtype: str = "float64"):
        self.stepper, self.dtype = stepper, getattr(torch, dtype)
        self.library = build(kicks_c(stepper, dtype), LOOPS.read_text(encoding="utf-8"))

    def rollout(self, q: Tensor, p: Tensor, s: Tensor | None = None, *, h: Tensor | float, steps: int) -> Rollout:
        """K equal steps from (q, p, s) with shapes (B, 1), (B, 1), (B)."""
        s = torch.zeros_like(q[..., 0]) if s is None else s
        h_all = torch.as_tensor(h, dtype=q.dtype).expand(len(q), steps)
        self.stepper.check_h(h_all)
        run, (states, status) = self.prepared(q, p, s, h_all)
        run()
        factor = math.exp(-self.stepper.rate * self.stepper.h)
        c = torch.where(status == Status.CONVERGED, factor, torch.nan).to(self.dtype)
        sigma = torch.cat([torch.ones_like(c[:, :1]), c], -1).cumprod(-1)
        return Rollout(states[..., :1], states[..., 1:2], states[..., 2], sigma, status, 0 * c)

    def prepared(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor) -> tuple[Callable[[], None], tuple[Tensor, Tensor]]:
        """The call of the loop in C with its arguments made beforehand, and its states (B, K+1, 3) and status (B, K).

        Of the steps h, (B, K), only the number is used: the size of a step is the stepper's own.
        """
        batch, steps = h.shape
        states = torch.full((batch, steps + 1, 3), torch.nan, dtype=self.dtype)
        states[:, 0] = join(q, p, s)
        status = torch.full((batch, steps), int(Status.DIVERGED), dtype=torch.uint8)
        addresses = (ctypes.c_void_p(x.data_ptr()) for x in (states, status))
        arguments = ctypes.c_long(batch), ctypes.c_long(steps), *addresses
        function = self.library.herglotz_kicks_rollouts
        return lambda keep=(states, status): function(*arguments), (states, status)  # noqa: ARG005  keeps the memory
