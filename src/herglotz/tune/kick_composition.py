"""A large explicit step of a few kicks and drifts, each kick with its own learned potential; and its form in C.

One degree of freedom, constant c = e^{−γh}. A step is half of the damping, then

    q ← q + d_0 p,  and for i = 1 … K:  p ← p − V_i′(q),  q ← q + d_i p,

and the other half. Every stage is the flow of a separable discrete Lagrangian with p = Δq/d and V_i at
its end. The step is therefore a contact map for all values of its numbers: Φ̃*η = c η with c = e^{−γh}, and each stage
adds one term to s. The V_i are trigonometric polynomials of an angle, or polynomials of a length. The d_i and V_i are
fitted to the map over h alone; the stages need not follow the motion inside the step. Compositions of Hénon-like maps
can approximate any symplectic map.

Source: D. Turaev, Nonlinearity 16 (2003) 123 (Hénon-like maps); S. Blanes, F. Casas and A. Murua, Acta Numerica 33
(2024) 1 (compositions with modified potentials).
"""

from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from herglotz.codegen.c_compiler import build
from herglotz.codegen.interpret import interpret
from herglotz.codegen.program import Program, as_scalars, whole
from herglotz.codegen.trace import PRIMES, traced
from herglotz.data.files import PathLike, write_atomically
from herglotz.errors import InputError
from herglotz.export.c_header import number, written
from herglotz.mechanics.contact import join
from herglotz.models import ContactLagrangian
from herglotz.stepping import OneStepMethod, Rollout, State, Status, Step
from herglotz.training import levenberg_marquardt
from herglotz.tune.distil import FlowProblem

# The levels with a constant c and no force.
LEVELS = ("conservative", "linear")
# Degree of the polynomial of a kick. A length has one degree more: its force is not zero at the middle of the data.
DEGREE = 4


@dataclass(frozen=True)
class KickStepper(OneStepMethod):
    """A stepper of kicks and drifts, with `step` and `rollout` as `Stepper` has them, at its own h only.

    V_i = Σ_n a_in cos nq + b_in sin nq for an angle, Σ_n a_in x^n, n ≥ 1, with x = (q − middle)/half for a length.
    `rate` is γ in c = e^{−γh}. `offset` is added to s after a step: the sum of the constants of the V_i, which move
    neither q nor p. `error` is the RMS error of q after a step, in units of q.
    """

    h: float
    rate: float
    angle: bool
    middle: float
    half: float
    drifts: Tensor  # (K + 1,) d_0 … d_K, in time over mass
    cosines: Tensor  # (K, N) a_in
    sines: Tensor  # (K, N) b_in
    offset: float = 0.0
    error: float = 0.0

    dof = 1

    @property
    def kicks(self) -> int:
        """Return K, the number of kicks."""
        return len(self.cosines)

    @property
    def parameters(self) -> int:
        """Return how many numbers were fitted."""
        return self.drifts.numel() + self.cosines.numel() + self.sines.numel()

    def kick(self, i: int, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return V_i(q) and V_i′(q), of the shape of q."""
        a, b = self.cosines[i], self.sines[i]
        n = torch.arange(1, len(a) + 1, dtype=q.dtype, device=q.device)
        if not self.angle:
            x = (q - self.middle) / self.half
            return x * _polynomial(a, x), _polynomial(n * a, x) / self.half
        # A kick takes a single cosine and sine, which are most of the work in C.
        c, sine = torch.cos(q), torch.sin(q)
        T, U = (x.to(q) for x in _multiple_angles(len(a)))
        V = _polynomial(a @ T, c) + sine * _polynomial(b @ U, c)
        return V, _polynomial((n * b) @ T, c) - sine * _polynomial((n * a) @ U, c)

    def map(self, q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return (q, p, s) after one step; q, p and s have shape (...)."""
        root = torch.exp(torch.tensor(-0.5 * self.rate * self.h, dtype=q.dtype, device=q.device))
        p, s = root * p, root * s
        q, s = q + self.drifts[0] * p, s + 0.5 * self.drifts[0] * p * p
        for i in range(self.kicks):
            V, slope = self.kick(i, q)
            p, s = p - slope, s - V
            q, s = q + self.drifts[i + 1] * p, s + 0.5 * self.drifts[i + 1] * p * p
        return q, root * p, root * s + self.offset

    def check_h(self, h: Tensor) -> None:
        """Raise InputError if a step is not the stepper's own."""
        wrong = h[~((h - self.h).abs() <= 1e-6 * self.h)]
        if len(wrong):
            raise InputError(f"this stepper was fitted to h = {self.h:g}, got {float(wrong[0]):g}")

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:  # noqa: ARG002
        """Take one step; NaN and `Status.DIVERGED` where the result is not finite.

        Raise InputError if h is not the stepper's own, or there is more than one coordinate.
        """
        self.check_h(torch.as_tensor(h, dtype=state.q.dtype))
        if state.q.shape[-1] != 1:
            raise InputError(f"kicks step one coordinate, got {state.q.shape[-1]}")
        q, p, s = self.map(state.q[..., 0], state.p[..., 0], state.s)
        new = State(q[..., None], p[..., None], s)
        status = torch.where(new.finite, Status.CONVERGED, Status.DIVERGED).to(torch.uint8)
        return Step.of(new, torch.full_like(s, -self.rate * self.h).exp(), status, torch.zeros_like(s), 0)


def _polynomial(coefficients: Tensor, x: Tensor) -> Tensor:
    """Σ_k c_k x^k by Horner's scheme, of the shape of x."""
    total = coefficients[-1] + 0 * x
    for c in reversed(coefficients[:-1].unbind()):
        total = c + x * total
    return total


@cache
def _multiple_angles(count: int) -> tuple[Tensor, Tensor]:
    """T and U of cos nq = Σ_k T_nk cos^k q and sin nq = sin q Σ_k U_nk cos^k q for n = 1 … count (Chebyshev)."""
    # (2, n, power) of both kinds for n = 0, 1, …
    powers = torch.zeros(2, count + 2, count + 2, dtype=torch.float64)
    powers[:, 0, 0], powers[0, 1, 1], powers[1, 1, 1] = 1.0, 1.0, 2.0
    for n in range(2, count + 1):
        powers[:, n] = 2 * powers[:, n - 1].roll(1, -1) - powers[:, n - 2]
    return powers[0, 1 : count + 1, : count + 1], powers[1, :count, :count]


def can_kick(model: ContactLagrangian) -> bool:
    """Return whether kicks can replace the model's step: one coordinate, a constant c and no forces."""
    return model.config.dof == 1 and model.config.level in LEVELS


def fit_kicks(
    model: ContactLagrangian,
    before: State,  # (T, 1), (T, 1), (T)
    after: State,  # (T, 1), (T, 1), (T)
    h: float,
    *,
    kicks: int,
    iterations: int = 150,
) -> KickStepper:
    """Fit kicks and drifts to a flow map over h by Levenberg–Marquardt on (q1, p1), each in units of its own size.

    The fit starts from leapfrog with the stiffness of the model, and keeps the model's γ. Raise InputError if the
    model has several coordinates, a c that varies, or forces.
    """
    if not can_kick(model):
        raise InputError(f"kicks need one coordinate at the {' or '.join(LEVELS)} level")
    before, after = (State(*(x.double() for x in states)) for states in (before, after))
    start = _leapfrog(model, before, h, kicks)
    p_size = before.p.square().mean().sqrt()
    sizes = torch.stack([torch.full_like(p_size, float(max(model.config.scale))), torch.where(p_size > 0, p_size, 1.0)])
    problem = FlowProblem(partial(_misses, start), before, after, sizes)
    first = torch.cat([start.drifts, start.cosines.flatten(), start.sines.flatten()])
    found = _with_numbers(start, levenberg_marquardt(problem, first, max_iterations=iterations, rtol=1e-5).x.detach())
    q, _, s = found.map(before.q[:, 0], before.p[:, 0], before.s)
    error = (q - after.q[:, 0]).square().mean().sqrt()
    return replace(found, offset=float((after.s - s).mean()), error=float(error))


def _with_numbers(stepper: KickStepper, theta: Tensor) -> KickStepper:
    """The stepper with the fitted numbers θ: drifts, cosines and sines."""
    d, a, b = theta.split([x.numel() for x in (stepper.drifts, stepper.cosines, stepper.sines)])
    cosines, sines = a.reshape(stepper.cosines.shape), b.reshape(stepper.sines.shape)
    return replace(stepper, drifts=d, cosines=cosines, sines=sines)


def _misses(stepper: KickStepper, theta: Tensor, before: State, after: State) -> Tensor:
    """The errors (..., 2) of q and p after a step with the numbers θ."""
    q, p, _ = _with_numbers(stepper, theta).map(before.q[..., 0], before.p[..., 0], before.s)
    return torch.stack([q - after.q[..., 0], p - after.p[..., 0]], -1)


def _leapfrog(model: ContactLagrangian, before: State, h: float, kicks: int) -> KickStepper:
    """Return K steps of leapfrog with the model's stiffness: drifts h/K over the mass, kicks h/K times the force."""
    angle, k = model.config.angles[0], float(model.config.stiffness[0])
    drifts = torch.full((kicks + 1,), h / kicks, dtype=torch.float64)
    drifts[0] = drifts[-1] = h / kicks / 2
    a = torch.zeros(kicks, DEGREE if angle else DEGREE + 1, dtype=torch.float64)
    b = torch.zeros(kicks, DEGREE if angle else 0, dtype=torch.float64)
    if angle:
        middle, half = 0.0, 1.0
        a[:, 0] = -k * h / kicks
    else:
        low, high = float(before.q.min()), float(before.q.max())
        middle, half = (low + high) / 2, (high - low) / 2
        a[:, 1] = 0.5 * k * half**2 * h / kicks
    rate = 0.0 if model.damping is None else float(model.damping.rate.detach())
    return KickStepper(h, rate, angle, middle, half, drifts, a, b)


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
    q, p, s = torch.linspace(-1, 1, 3 * PRIMES[0], dtype=torch.float64).chunk(3)
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
