"""The classical methods in C, on the true equations or on a network: built, run and counted."""

from __future__ import annotations

import ctypes
import functools
import math
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.integrate._ivp import dop853_coefficients as dop
from torch import Tensor

from herglotz.export.c_wrapper import FLAGS, compiler

SYSTEMS = {"damped_pendulum": 0, "double_pendulum": 1, "damped_oscillator": 2, "parachute": 3, "kepler": 4, "chain": 5,
           "driven_pendulum": 6, "rigid_body": 7}  # fmt: skip
NETWORK = 9
METHODS = {"RK4": 0, "DOP853": 1, "implicit midpoint": 2, "leapfrog": 3, "DOP853 fixed": 4}
SEPARABLE = ("damped_pendulum", "damped_oscillator", "kepler", "chain", "driven_pendulum")
REAL = {"float64": "double", "float32": "float"}

# Floating-point operations of one right-hand side, counted in work_precision.c: + − × are 1, ÷ and √ 4, sin and cos 20.
FLOPS = {"damped_pendulum": 23, "driven_pendulum": 24, "damped_oscillator": 3, "parachute": 3, "kepler": 20,
         "double_pendulum": 116, "chain": 90, "rigid_body": 112}  # fmt: skip


@dataclass(frozen=True)
class Weights:
    """A network a(q, v): (sin q, cos q, v) or (q, v) → tanh → (tanh →) a."""

    values: Tensor  # (P,)
    dof: int
    width: int
    layers: int
    angles: bool

    @property
    def inputs(self) -> int:
        """Numbers that enter the first layer."""
        return (3 if self.angles else 2) * self.dof

    @property
    def flops(self) -> int:
        """Of one evaluation: 2 a weight, 25 a tanh, 20 a sine or cosine."""
        hidden = self.width * self.layers
        return 2 * len(self.values) + 25 * hidden + (40 * self.dof if self.angles else 0)


class Native:
    """One compiled set of methods: of a scene's true equations, or of a network."""

    def __init__(
        self,
        name: str,
        dtype: str,
        weights: Weights | None = None,
        dof: int = 1,
        fast: bool = True,
        constants: Mapping[str, float] | None = None,
    ):
        self.dof = dof
        system = SYSTEMS[name] if weights is None else NETWORK
        defines = {"SYSTEM": system, "DOF": dof, "real": REAL[dtype], "FAST_SINE": int(fast), **_constants()}
        defines |= {k: repr(v) for k, v in (constants or {}).items()}
        if weights is not None:
            defines |= {"IN": weights.inputs, "WIDTH": weights.width, "LAYERS": weights.layers}
            defines["ANGLES"] = int(weights.angles)
        with tempfile.TemporaryDirectory() as folder:
            here = Path(folder)
            (here / "dop853_step.h").write_text(dop853_source())
            words = [f"-D{k}={v}" for k, v in defines.items()]
            source = Path(__file__).with_name("work_precision.c")
            target = here / "m.so"
            command = [*compiler(), *FLAGS, *words, f"-I{here}", "-w", "-shared", "-fPIC", "-o", target, source, "-lm"]
            subprocess.run([str(x) for x in command], check=True)
            self.library = ctypes.CDLL(str(target))
        self.library.motions.restype = ctypes.c_long
        if weights is not None:
            values = weights.values.double().contiguous()
            self.library.set_weights(ctypes.c_void_p(values.data_ptr()))

    def motions(
        self, y: Tensor, T: float, checks: int, method: str, x: float, u: Tensor | None = None
    ) -> tuple[Tensor, int]:
        """Positions (B, checks, n) at equal times up to T, and the evaluations of f."""
        out = torch.empty(len(y), checks, y.shape[1], dtype=torch.float64)
        count = self.call(y, T, checks, method, x, u, out)()
        return out[..., : self.dof], count

    def call(
        self,
        y: Tensor,
        T: float,
        checks: int,
        method: str,
        x: float,
        u: Tensor | None = None,
        out: Tensor | None = None,
    ) -> Any:
        """The call in C, its arguments made beforehand."""
        y = y.double().contiguous()
        u = None if u is None else u.double().contiguous()
        arguments = (
            ctypes.c_long(len(y)), ctypes.c_long(checks), ctypes.c_double(T / checks), ctypes.c_int(METHODS[method]),
            ctypes.c_double(x), ctypes.c_double(0.0), _pointer(u), _pointer(y), _pointer(out),
        )  # fmt: skip
        return lambda keep=(y, u, out): self.library.motions(*arguments)  # noqa: ARG005


def _pointer(x: Tensor | None) -> ctypes.c_void_p:
    return ctypes.c_void_p(None if x is None else x.data_ptr())


def dop853_source() -> str:
    """One step of DOP853, with and without its error, every coefficient written out, from the tables in scipy."""

    def total(weights: Any) -> str:
        return " + ".join(f"(real){float(w)!r} * k[{j}][d]" for j, w in enumerate(weights) if w)

    stages = []
    for i in range(1, dop.N_STAGES):
        stages.append(f"  for (d = 0; d < D; d++) z[d] = y[d] + h * ({total(dop.A[i, :i])});\n  rhs(z, k[{i}]);")
    lines = ["static real attempt(const real *y, const real *f, real h, real tol, real *y_new, real *f_new) {",
             "  real k[12][D], z[D], e5 = 0, e3 = 0; int d;", "  memcpy(k[0], f, sizeof k[0]);", *stages]  # fmt: skip
    lines.append(f"  for (d = 0; d < D; d++) y_new[d] = y[d] + h * ({total(dop.B)});\n  rhs(y_new, f_new);")
    lines.append("  for (d = 0; d < D; d++) {\n    const real a = fabs(y[d]), b = fabs(y_new[d]);")
    lines.append("    const real scale = 1 / (tol + tol * (a > b ? a : b));")
    lines.append(f"    const real u = ({total(dop.E5[:12])}) * scale, w = ({total(dop.E3[:12])}) * scale;")
    lines.append("    e5 += u * u; e3 += w * w;\n  }")
    lines.append("  if (e5 == 0 && e3 == 0) return 0;\n  return h * e5 / sqrt((e5 + (real)0.01 * e3) * D);\n}\n")
    lines += [
        "static void fixed8(real *y, real h, long steps) {",
        "  real k[12][D], z[D]; int d;",
        "  while (steps--) {",
    ]
    lines += ["  rhs(y, k[0]);", *stages]
    lines.append(f"  for (d = 0; d < D; d++) y[d] += h * ({total(dop.B)});\n  }}\n}}\n")
    return "\n".join(lines)


@functools.cache
def _constants() -> Mapping[str, str]:
    """Polynomials of sin and cos on |r| ≤ π/2, and of tanh as a quotient on |z| ≤ 9, fitted here."""
    r2 = (math.pi / 2) ** 2 * 0.5 * (1 - np.cos(np.pi * (np.arange(400) + 0.5) / 400))
    found = {}
    for name, wanted in (("SIN", np.sinc(np.sqrt(r2) / np.pi)), ("COS", np.cos(np.sqrt(r2)))):
        fit = np.polynomial.Chebyshev.fit(r2, wanted, 5, domain=[0.0, (math.pi / 2) ** 2])
        c = np.asarray(fit.convert(kind=np.polynomial.Polynomial).coef)
        assert np.abs(np.polynomial.polynomial.polyval(r2, c) - wanted).max() < 1e-8
        found |= {f"{name}{i}": repr(float(x)) for i, x in enumerate(c)}
    z = 4.5 * (1 - np.cos(np.pi * (np.arange(4000) + 0.5) / 4000))
    scale = 81.0  # powers of z²/81: the system is well conditioned
    V, t = np.vander(z * z / scale, 6, increasing=True), np.tanh(z)
    a = b = np.eye(6)[0]
    for _ in range(20):  # linearised: divide by the last denominator
        w = 1 / (V @ b)
        system = np.concatenate([z[:, None] * V, -t[:, None] * V[:, 1:]], 1) * w[:, None]
        norms = np.linalg.norm(system, axis=0)
        x = np.linalg.lstsq(system / norms, t * w, rcond=None)[0] / norms
        a, b = x[:6], np.r_[1.0, x[6:]]
    assert np.abs(z * (V @ a) / (V @ b) - t).max() < 1e-6
    powers = scale ** -np.arange(6.0)
    found |= {f"TANH_A{i}": repr(float(x)) for i, x in enumerate(a * powers)}
    return found | {f"TANH_B{i}": repr(float(x)) for i, x in enumerate(b * powers)}
