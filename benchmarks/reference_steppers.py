"""The same step in other hands, for `stepper.py`: plain C and JAX."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks.harness import compiled
from herglotz.models import ContactLagrangian
from herglotz.models.terms import Kinetic

NEWTON = 2  # iterations of JAX, which has no test to end them by
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


def jax_rollout(model: ContactLagrangian) -> Callable[..., Any] | None:
    """`rollout(q, p, s, h, steps)` → q (steps, B, 2): a jitted scan of Newton steps on grad and jacfwd, or None.

    Of two coordinates.
    """
    try:
        import jax  # pyright: ignore[reportMissingImports]
        import jax.numpy as jnp  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    jax.config.update("jax_enable_x64", True)
    dtype = jnp.float32 if next(model.parameters()).dtype == torch.float32 else jnp.float64
    w = {name: jnp.asarray(value.double().numpy(), dtype) for name, value in parts(model).items()}
    energy = dtype(sum(v * v for v in model.config.speed))
    damping: Any = model.damping
    rate = dtype(damping.rate.item())

    def features(q):
        return jnp.stack([jnp.sin(q), jnp.cos(q)], -1).reshape(-1)

    def potential(q):
        value = jnp.sum(w["stiffness"] * (1 - jnp.cos(q)) + w["tilt"] * jnp.sin(q))
        return value + energy * (w["vl"] @ jnp.tanh(w["vw"] @ features(q) + w["vb"]))[0]

    def moving(q0, d, h):
        """What depends on q1 besides V(q1); the terms in s0 and V0 do not."""
        x = jnp.concatenate([features(q0 + d / 2), d / (h * w["speed"])])
        a = jnp.tanh(w["w1"] @ jnp.tanh(w["w0"] @ x + w["b0"]) + w["b1"])
        return jnp.exp(-rate * h / 2) * (d @ w["mass"] @ d) / (2 * h) + h * energy * (w["last"] @ a)[0]

    def inverse(J, F):
        determinant = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
        return jnp.stack([J[1, 1] * F[0] - J[0, 1] * F[1], J[0, 0] * F[1] - J[1, 0] * F[0]]) / determinant

    # D1 and D2 of A(q0, q1) = moving(q0, q1 - q0); V is evaluated once a step, as in the C
    slope = jax.grad(moving, (0, 1))

    def step(carry, _):
        q, p, s, V0, dV0, old, h = carry
        c = jnp.exp(-rate * h)
        push = c * (p - h / 2 * dV0)

        def equation(d):
            by_q, by_d = slope(q, d, h)
            return push + by_q - by_d

        d = 3 * (old[0] - old[1]) + old[2]
        for _k in range(NEWTON):
            d = d - inverse(jax.jacfwd(equation)(d), equation(d))
        q1 = q + d
        V1, dV1 = jax.value_and_grad(potential)(q1)
        p1 = slope(q, d, h)[1] - h / 2 * dV1
        s1 = c * s + moving(q, d, h) - h / 2 * (c * V0 + V1)
        return (q1, p1, s1, V1, dV1, jnp.stack([d, old[0], old[1]]), h), q1

    def run(q, p, s, h, steps):
        V0, dV0 = jax.value_and_grad(potential)(q)
        start = h * jnp.linalg.solve(w["mass"], p)
        carry = (q, p, s, V0, dV0, jnp.stack([start] * 3), h)
        return jax.lax.scan(step, carry, None, length=steps)[1]

    batched = jax.jit(jax.vmap(run, (0, 0, 0, None, None), 1), static_argnums=4)

    def rollout(q: Tensor, p: Tensor, s: Tensor, h: float, steps: int):
        arrays = [jnp.asarray(x.numpy(), dtype) for x in (q, p, s)]
        return batched(*arrays, dtype(h), steps).block_until_ready()

    return rollout
