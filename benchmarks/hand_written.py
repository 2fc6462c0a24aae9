"""The same step in plain C that was written by hand, for `stepper.py`."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import compiled
from herglotz.models import ContactLagrangian
from herglotz.models.terms import Kinetic

HAND_FLAGS = ("-std=c99", "-O3", "-march=native", "-ffast-math")


def parts(model: ContactLagrangian) -> dict[str, Tensor]:
    """The numbers of a linear-level model whose coordinates are angles, with both networks."""
    potential, correction = model.potential.network, model.correction
    assert potential is not None
    assert correction is not None
    assert isinstance(model.kinetic, Kinetic)
    net = correction.network
    named = {
        "mass": model.kinetic.mass(),
        "stiffness": model.potential.stiffness,
        "tilt": model.potential.tilt,
        "speed": torch.tensor(model.config.speed, dtype=torch.float64),
        "vw": potential.weights[0],
        "vb": potential.biases[0],
        "vl": potential.weights[1],
        "w0": net.weights[0],
        "b0": net.biases[0],
        "w1": net.weights[1],
        "b1": net.biases[1],
        "last": net.weights[2],
    }
    return {name: value.detach() for name, value in named.items()}


class Hand:
    """`hand_written.c` with this model's weights."""

    def __init__(self, model: ContactLagrangian):
        dtype = next(model.parameters()).dtype
        self.dtype, self.n = dtype, model.config.dof
        single = dtype == torch.float32
        real, tanh = ("float", "tanhf") if single else ("double", "tanh")
        arrays = parts(model)
        width, narrow = len(arrays["b0"]), len(arrays["vb"])
        lines = [f"typedef {real} real;", f"#define TANH {tanh}"]
        lines.append(f"enum {{ N = {self.n}, VW = {narrow}, W = {width} }};")
        if single:  # what <tgmath.h> would do
            lines += [f"#define {f} {f}f" for f in ("sin", "cos", "exp", "fabs", "fmax")]
        damping: Any = model.damping
        lines.append(f"#define RATE (real){damping.rate.item()!r}")
        lines.append(f"#define ENERGY (real){sum(v * v for v in model.config.speed)!r}")
        lines.append(f"#define EPS (real){torch.finfo(dtype).eps!r}")
        for name, value in arrays.items():
            numbers = ", ".join(repr(x) for x in value.double().reshape(-1).tolist())
            lines.append(f"static const real {name}[] = {{{numbers}}};")
        self.library = compiled("hand_written.c", "weights.h", "\n".join(lines) + "\n", *HAND_FLAGS)

    def rollout(self, q: Tensor, p: Tensor, s: Tensor, h: float, steps: int) -> Tensor:
        """Positions after each step, (steps, n)."""
        state = [x.to(self.dtype).clone().contiguous() for x in (q, p, s.reshape(1))]
        out = torch.empty(steps, self.n, dtype=self.dtype)
        real = ctypes.c_float if self.dtype == torch.float32 else ctypes.c_double
        pointers = [ctypes.c_void_p(x.data_ptr()) for x in (*state, out)]
        self.library.hand_rollout(ctypes.c_long(steps), real(h), *pointers)
        return out
