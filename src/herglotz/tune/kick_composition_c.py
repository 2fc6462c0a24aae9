"""The C form of a `KickStepper`: one short header of straight-line code without dependencies.

sin and cos are polynomials on (−π/2, π/2) after the nearest multiple of π is subtracted; their error is a thirtieth of
the step's own. Library functions would take longer than the rest of the step. Inside a step an angle is counted in half
turns, which saves one product a kick. The potentials are polynomials in cos q, and sin q times polynomials in cos q,
summed by Estrin's scheme, whose operations a processor can overlap.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.polynomial import chebyshev, polynomial as power

from herglotz.codegen.c_compiler import build
from herglotz.codegen.c_function import as_scalars
from herglotz.data.files import PathLike, write_atomically
from herglotz.errors import InputError
from herglotz.export import c_numbers
from herglotz.export.c_header import runtime
from herglotz.stepping import Rollout, State, Status
from herglotz.tune.kick_composition import KickStepper

FINEST, COARSEST = {"float64": 1e-13, "float32": 3e-8}, 1e-4  # bounds of the error that sin and cos may have
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

static inline void herglotz_kicks_step(herglotz_kicks_state *x) {{
  herglotz_real q = x->q * {inverse}, p = {root} * x->p, s = {root} * x->s;
{body}
  x->q = q * {unit};
  x->p = {root} * p;
  x->s = {root} * s + {offset};
}}

#endif
"""

# What the loop over steps of the C runtime (`runtime/run.h`) asks of a step, and the loop over motions. Outputs are
# (batch, steps + 1), statuses and residuals (batch, steps). Each motion waits for the one before, as in a control loop.
RUNTIME = ("types.h", "numbers.h", "checks.h")
DEFINED = """#include "stepper.h"
#define hz_N 1
#define hz_M 0
#define hz_INPUTS 0
#define hz_BOXED 0
#define hz_WIDE 0
#define hz_SINGLE {single}
typedef herglotz_real hz_real;
static const hz_real hz_h_low = HERGLOTZ_KICKS_H_STEP, hz_h_high = HERGLOTZ_KICKS_H_STEP;
"""
STEP = """
typedef int hz_track; /* nothing is carried along */
static inline void hz_track_start(const hz_state *x, hz_track *track) { *track = x != 0; }
static inline void hz_get(const hz_state *x, int w, hz_state *one) { *one = x[w]; }
static inline void hz_set(hz_state *x, int w, const hz_state *one) { x[w] = *one; }
static inline void hz_take(hz_state *x, hz_track *track, const hz_real h[1], int status[1], hz_real residual[1]) {
  herglotz_kicks_state now = {x->q[0], x->p[0], x->s};
  (void)track;
  (void)h;
  residual[0] = 0;
  if (status[0]) return;
  herglotz_kicks_step(&now);
  if (!hz_finite((now.q + now.p) + now.s)) {
    status[0] = hz_DIVERGED;
    return;
  }
  x->q[0] = now.q;
  x->p[0] = now.p;
  x->s = now.s;
  x->sigma *= HERGLOTZ_KICKS_FACTOR;
}
"""
BATCH = """
void herglotz_kicks_rollouts(long batch, long steps, double wait, const hz_real *q0, const hz_real *p0,
    const hz_real *s0, hz_real *q, hz_real *p, hz_real *s, hz_real *sigma, unsigned char *status, hz_real *residual) {
  const hz_real h = HERGLOTZ_KICKS_H_STEP;
  const hz_job job = {steps, 1, &h, 0, 0, q, p, s, sigma, residual, status};
  hz_state x = {{0}, {0}, 0, 1};
  long b;
  for (b = 0; b < batch; b++) {
    const hz_real last = (hz_real)wait * x.q[0];
    int failed = hz_CONVERGED;
    x.q[0] = q0[b] + last;
    x.p[0] = p0[b] + last;
    x.s = s0[b];
    x.sigma = 1;
    hz_run(&x, b, 1, &job, &failed, 0);
  }
}
"""


def kicks_c(stepper: KickStepper, dtype: str = "float64") -> str:
    """The header, for numbers of this dtype; raise InputError if the dtype has no C form."""
    if dtype not in TYPES:
        raise InputError(f"dtype must be float64 or float32, got {dtype}")
    number = partial(c_numbers.number, dtype=dtype)
    root = math.exp(-0.5 * stepper.rate * stepper.h)
    unit = math.pi if stepper.angle else 1.0
    drifts = [f"  s += {number(0.5 * d)} * p * p;\n  q += {number(d / unit)} * p;" for d in stepper.drifts.tolist()]
    body = [drifts[0], *(_kick(stepper, i, dtype) + drifts[i + 1] for i in range(stepper.kicks))]
    return HEADER.format(
        h=number(stepper.h), kicks=stepper.kicks, c=number(root * root), root=number(root), real=TYPES[dtype],
        body="\n".join(body), unit=number(unit), inverse=number(1 / unit), offset=number(stepper.offset),
    )  # fmt: skip


def export_kicks_c(stepper: KickStepper, path: PathLike, dtype: str = "float64") -> Path:
    """Write the header."""
    path = Path(path)
    write_atomically(path, kicks_c(stepper, dtype).encode())
    return path


class CompiledKicks:
    """A `KickStepper` compiled: `rollout` as there."""

    def __init__(self, stepper: KickStepper, dtype: str = "float64"):
        self.h, self.dtype = stepper.h, getattr(torch, dtype)
        parts = [DEFINED.format(single=int(dtype == "float32")), *map(runtime, RUNTIME)]
        self.library = build(kicks_c(stepper, dtype), "".join([*parts, STEP, as_scalars(runtime("run.h")), BATCH]))

    def rollout(
        self, q: torch.Tensor, p: torch.Tensor, s: torch.Tensor | None = None, *, h: torch.Tensor | float, steps: int
    ) -> Rollout:
        """K equal steps from (q, p, s) with shapes (B, 1), (B, 1), (B)."""
        if not abs(float(h) - self.h) <= 1e-6 * self.h:
            raise InputError(f"this stepper was fitted to h = {self.h:g}, got {float(h):g}")
        s = torch.zeros_like(q[..., 0]) if s is None else s
        run, (q, p, s, sigma, status, left) = self.prepared(State(q, p, s), steps)
        run()
        return Rollout(q[..., None], p[..., None], s, sigma, status, left)

    def prepared(self, start: State, steps: int) -> tuple[Callable[[], None], list[torch.Tensor]]:
        """The call of the loop in C with its arguments made beforehand, and the tensors that the loop writes."""
        arrays = [x.to(self.dtype).reshape(-1).contiguous() for x in start]
        count = len(arrays[0])
        outputs = [torch.full((count, steps + 1), torch.nan, dtype=self.dtype) for _ in range(4)]
        outputs += [torch.full((count, steps), int(Status.DIVERGED), dtype=torch.uint8)]
        outputs += [torch.full((count, steps), torch.nan, dtype=self.dtype)]
        pointers = [ctypes.c_void_p(x.data_ptr()) for x in (*arrays, *outputs)]
        function, sizes = self.library.herglotz_kicks_rollouts, (ctypes.c_long(count), ctypes.c_long(steps))
        return lambda keep=(arrays, outputs): function(*sizes, ctypes.c_double(0.0), *pointers), outputs  # noqa: ARG005


def _kick(stepper: KickStepper, i: int, dtype: str) -> str:
    number = partial(c_numbers.number, dtype=dtype)
    a, b = stepper.cosines[i].double().numpy(), stepper.sines[i].double().numpy()
    n = np.arange(1, len(a) + 1)
    if stepper.angle:
        even, odd = chebyshev.cheb2poly(np.r_[0.0, a]), _second_kind(b)  # V = even(c) + sin q · odd(c)
        slope, turn = chebyshev.cheb2poly(np.r_[0.0, n * b]), _second_kind(n * a)  # V′ = slope(c) − sin q · turn(c)
        error = min(max(stepper.error / 30, FINEST[dtype]), COARSEST)
        lines = [_sine_and_cosine(error, number)]
        lines += [f"    s -= {_sum(even, 'c', number)} + sine * {_sum(odd, 'c', number)};"]
        lines += [f"    p = (p - {_sum(slope, 'c', number)}) + sine * {_sum(turn, 'c', number)};"]
    else:
        V = np.r_[0.0, a]
        shift = f"(q - {number(stepper.middle)}) * {number(1 / stepper.half)}"
        lines = [f"    const herglotz_real c = {shift};", f"    s -= {_sum(V, 'c', number)};"]
        lines += [f"    p -= {_sum(power.polyder(V) / stepper.half, 'c', number)};"]
    return "\n".join(["  {", *lines, "  }", ""])


def _second_kind(b: np.ndarray) -> np.ndarray:
    """Coefficients in c of Σ_n b_n U_{n−1}(c): sin nq = sin q · U_{n−1}(cos q)."""
    total, before, now = np.zeros(max(1, len(b))), np.zeros(1), np.ones(1)
    for weight in b:
        total[: len(now)] += weight * now
        before, now = now, power.polysub(power.polymul([0.0, 2.0], now), before)
    return total


def _sum(coefficients: np.ndarray, x: str, number: Any) -> str:
    """Estrin's scheme for Σ c_k x^k, as an expression; high zero coefficients are left out."""
    terms = [number(c) for c in np.trim_zeros(coefficients, "b")] or [number(0.0)]
    while len(terms) > 1:
        pairs = [f"({a} + {x} * {b})" for a, b in zip(terms[::2], terms[1::2], strict=False)]
        terms = pairs + ([terms[-1]] if len(terms) % 2 else [])
        x = f"({x} * {x})"
    return terms[0]


def _sine_and_cosine(error: float, number: Any) -> str:
    """C for `sine` and `c` of πq: polynomials of r, q less the nearest whole number, with the sign of its parity."""
    odd, even = (_fitted(kind, error) for kind in ("sin", "cos"))
    return "\n".join(
        [
            "    const herglotz_real turns = rint(q), r = q - turns, r2 = r * r;",
            f"    const herglotz_real sign = 1 - 2 * (turns - 2 * floor({number(0.5)} * turns));",
            f"    const herglotz_real sine = sign * r * {_sum(odd, 'r2', number)};",
            f"    const herglotz_real c = sign * {_sum(even, 'r2', number)};",
        ]
    )


def _fitted(kind: str, error: float) -> np.ndarray:
    """Coefficients in r² of sin(πr)/r or cos πr on |r| ≤ 1/2, as few as the error allows."""
    nodes = 0.125 * (1 - np.cos(np.pi * (np.arange(400) + 0.5) / 400))
    root = np.sqrt(nodes)
    wanted = np.cos(np.pi * root) if kind == "cos" else np.pi * np.sinc(root)
    for degree in range(2, 12):
        fit = chebyshev.Chebyshev.fit(nodes, wanted, degree, domain=[0.0, 0.25])
        found = np.asarray(fit.convert(kind=np.polynomial.Polynomial).coef)
        if np.abs(power.polyval(nodes, found) - wanted).max() < error:
            return found
    raise AssertionError(f"no polynomial for {kind}")
