"""What learned steppers stand beside, in C: classical methods on the true equations, and neural ODEs on the same data.

`work_precision.c` is compiled for a scene, for a network, or for constants that were learned; the coefficients of
DOP853 are written into it from the tables in scipy.
"""

from __future__ import annotations

import ctypes
import functools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.func import jacrev, vmap

from benchmarks.harness import compiled, seconds
from benchmarks.peers.rollouts import rk4
from benchmarks.work_precision_ways import CHECKS, Case, Setup, Timed, judged
from herglotz.codegen.c_compiler import FLAGS
from herglotz.data import simulate
from herglotz.stepping import State
from herglotz.training import levenberg_marquardt
from herglotz.tune.cost import Timed as Timing

TIMED, PER = 16, 4e-3  # motions and seconds of one timing, at least: far above the resolution of the clock
# Numbers of SYSTEM in work_precision.c.
SYSTEMS = {"damped_pendulum": 0, "double_pendulum": 1}
NETWORK = 2
# Numbers of work_precision.c.
METHODS = {"RK4": 0, "DOP853": 1, "leapfrog": 2, "DOP853 fixed": 3}
REAL = {"float64": "double", "float32": "float"}


@dataclass(frozen=True)
class Weights:
    """A network a(q, v): (sin q, cos q, v) → tanh → (tanh →) a."""

    values: Tensor  # (P,)
    dof: int
    width: int
    layers: int

    @property
    def inputs(self) -> int:
        """Numbers that enter the first layer."""
        return 3 * self.dof


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
        words = [f"-D{k}={v}" for k, v in defines.items()]
        self.library = compiled("work_precision.c", "dop853_step.h", dop853_source(), *FLAGS, *words, "-w")
        self.library.motions.restype = ctypes.c_long
        if weights is not None:
            values = weights.values.double().contiguous()
            self.library.set_weights(ctypes.c_void_p(values.data_ptr()))


@dataclass(frozen=True)
class Motions:
    """What is asked of compiled methods: positions of motions at equal times up to T."""

    library: Native
    y: Tensor  # (B, 2n) starts
    T: float
    checks: int  # times
    method: str
    x: float  # steps between two times, or a tolerance

    def made(self) -> tuple[Tensor, int]:
        """Positions (B, checks, n), and the evaluations of f."""
        out = torch.empty(len(self.y), self.checks, self.y.shape[1], dtype=torch.float64)
        return out[..., : self.library.dof], self._call(len(self.y), out)()

    def timing(self) -> Timing:
        """Some of the motions, as often as makes the call long enough to time; a step is one motion."""
        call = self._call(TIMED, None)
        call()
        times = max(1, round(PER / max(1e-7, seconds(call, time.perf_counter))))

        def run() -> None:
            for _ in range(times):
                call()

        return Timing(run, times * len(self.y[:TIMED]))

    def _call(self, most: int, out: Tensor | None) -> Callable[[], int]:
        """The call in C, its arguments made beforehand."""
        y = self.y[:most].double().contiguous()
        arguments = (
            ctypes.c_long(len(y)), ctypes.c_long(self.checks), ctypes.c_double(self.T / self.checks),
            ctypes.c_int(METHODS[self.method]), ctypes.c_double(self.x), ctypes.c_double(0.0),
            *(ctypes.c_void_p(None if x is None else x.data_ptr()) for x in (y, out)),
        )  # fmt: skip
        return lambda keep=(y, out): self.library.library.motions(*arguments)  # noqa: ARG005


def dop853_source() -> str:
    """One step of DOP853, with and without its error, every coefficient written out, from the tables in scipy."""
    from scipy.integrate._ivp import dop853_coefficients as dop  # pyright: ignore[reportMissingImports]

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
    lines.append("static void fixed8(real *y, real h, long steps) {\n  real k[12][D], z[D]; int d;")
    lines += ["  while (steps--) {\n  rhs(y, k[0]);", *stages]
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


PAIRS, ROWS = 700, 2000  # pairs of states; of several coordinates fewer
PARTS = 4  # RK4 steps between two samples


def train_neural_ode(data: Any, setup: Setup, width: int, layers: int, iterations: int, seed: int = 0) -> Weights:
    """Weights of a = net(sin q, cos q, v), fitted to exact states h apart.

    It is given what the learned steppers are not: the exact velocities.
    """
    system = setup.scene
    n = system.dof
    blank = Weights(torch.empty(0), n, width, layers)
    sizes = [(blank.inputs, width), (width,), *([(width, width), (width,)] if layers == 2 else []), (n, width)]
    generator = torch.Generator().manual_seed(seed)
    first = [torch.randn(s, generator=generator, dtype=torch.float64) / s[0] ** 0.5 for s in sizes]
    first[-1] = first[-1] * 0.1
    theta = torch.cat([x.flatten() for x in first])
    y = torch.cat([data.q, system.velocity(data.q, data.p, data.s)], -1)
    keep = torch.ones(len(y), dtype=torch.bool)
    keep[torch.tensor(data.offsets) + torch.tensor(data.lengths) - 1] = False
    rows = keep.nonzero()[:, 0]
    rows = rows[torch.randperm(len(rows), generator=generator)[: min(PAIRS, ROWS // n)]]
    pairs = (y[rows], y[rows + 1])

    def rhs(w: list[Tensor], y: Tensor) -> Tensor:
        q, v = y[..., :n], y[..., n:]
        x = torch.cat([q.sin(), q.cos(), v], -1)
        x = torch.tanh(x @ w[0] + w[1])
        if layers == 2:
            x = torch.tanh(x @ w[2] + w[3])
        return torch.cat([v, x @ w[-1].T], -1)

    def local(theta: Tensor, y: Tensor, y1: Tensor) -> Tensor:
        w = [x.reshape(s) for x, s in zip(theta.split([math.prod(s) for s in sizes]), sizes, strict=True)]
        return (rk4(lambda y: rhs(w, y), y, setup.h, PARTS) - y1) / setup.h

    class Problem:
        sigma = 1e-8

        def cost(self, x: Tensor) -> Tensor:
            return (local(x, *pairs) / self.sigma).square().sum() / 2 + (x - theta).square().sum() / 200

        def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            r = local(x, *pairs).reshape(-1) / self.sigma
            J = vmap(jacrev(local), (None, 0, 0))(x, *pairs).reshape(-1, len(x)) / self.sigma
            A, b = torch.eye(len(x), dtype=x.dtype) / 100, (x - theta) / 100
            return self.cost(x), A + J.T @ J, b + J.T @ r

    found = levenberg_marquardt(Problem(), theta, max_iterations=iterations, rtol=1e-4)
    return Weights(found.x.detach(), n, width, layers)


def classical(case: Case) -> list[Timed]:
    """RK4, DOP853 and leapfrog on the true equations."""
    setup, name = case.setup, case.setup.name
    y = torch.cat([case.start.q, setup.scene.velocity(*case.start)], -1)
    found = []
    for dtype in ("float64", "float32"):
        library = Native(name, dtype, dof=setup.scene.dof)
        # Leapfrog is a method for separable Hamiltonians.
        for method in METHODS if name == "damped_pendulum" else [m for m in METHODS if m != "leapfrog"]:
            for x in _settings(method, dtype):
                label = _label(method, x, setup, dtype)
                point = {"kind": f"{method}, true equations", "setting": label, "dtype": dtype}
                found.append(_classic(point, library, case, y, method, x))
    return found


def _settings(method: str, dtype: str) -> list[float]:
    double = dtype == "float64"
    if method == "DOP853":
        return [10.0**-k for k in range(1, 11 if double else 6)]
    if method == "DOP853 fixed":
        return [1, 2, 3, 4, 6, *([8, 12] if double else [])]
    if method == "leapfrog":
        return [8, 16, 32, 128, *([512] if double else [])]
    return [4, 6, 8, 12, 16, 24, 32, *([64, 128] if double else [])]


def _label(method: str, x: float, setup: Setup, dtype: str) -> str:
    size = f"tol {x:.0e}" if method == "DOP853" else f"h {setup.T / CHECKS / x:.3g}"
    return f"{method}, {size}, {dtype}"


def _classic(point: dict, library: Native, case: Case, y: Tensor, method: str, x: float) -> Timed:
    """One setting."""
    asked = Motions(library, y, case.setup.T, CHECKS, method, x)
    return Timed({**point, **judged(asked.made()[0], case.truth)}, asked.timing(), case.setup.T)


def neural(case: Case) -> list[Timed]:
    """Neural ODEs of several sizes, by RK4 and DOP853."""
    setup = case.setup
    size = {"trajectories": setup.trajectories, "steps": setup.steps, "h": setup.h, "seed": case.seed}
    data = simulate(setup.scene, **size, keep_state=True)
    y = torch.cat([case.start.q, setup.scene.velocity(*case.start)], -1)
    found, began = [], time.process_time()
    for width, layers in setup.neural:
        weights = train_neural_ode(data, setup, width, layers, setup.neural_iterations, case.seed)
        for dtype in ("float64", "float32"):
            library = Native(setup.name, dtype, weights, setup.scene.dof)
            for method in ("RK4", "DOP853"):
                for x in _settings(method, dtype)[:7]:
                    label = f"{width} × {layers}, {_label(method, x, setup, dtype)}"
                    point = {"kind": f"neural ODE, {method}", "setting": label, "dtype": dtype}
                    found.append(_classic(point, library, case, y, method, x))
    case.seconds["neural ODE"] = time.process_time() - began
    return found


def equation(case: Case) -> list[Timed]:
    """RK4 and DOP853 on the *learned* Lagrangian's own Herglotz equation, in C: no contact map, nothing is solved.

    For two links told as such; the entry is the learned model's, from two positions.
    """
    setup, model = case.setup, case.run.model
    if setup.name != "double_pendulum" or not case.run.decided.features:
        return []
    constants, found = constants_of(model), []
    y = torch.cat([case.entry.q, _velocity(constants, case.entry)], -1)
    for dtype in ("float64", "float32"):
        library = Native(setup.name, dtype, dof=2, constants=constants)
        sizes = {"RK4": (4, 5, 6, 7, 8, 10, 12, 16), "DOP853 fixed": (2, 3, 4)}
        for method, x in ((method, x) for method, steps in sizes.items() for x in steps):
            h, words = setup.T / CHECKS / x, method.replace(" fixed", ", equal steps")
            point = {"kind": "learned equation", "setting": f"{words}, h {h:.3g}, C {dtype}", "dtype": dtype, "h": h}
            found.append(_classic(point, library, case, y, method, x))
    return found


def constants_of(model: Any) -> dict[str, float]:
    """The learned numbers of K = (M00 v0² + 2(M01 + MC cos(q0 − q1)) v0 v1 + M11 v1²)/2, V = −G0 cos q0 − G1 cos q1."""
    with torch.no_grad():
        K, base, P = model.kinetic, model.kinetic.base.mass(), model.potential.features.sum
        # Sines are none by symmetry.
        V = {tuple(x.form): w for x, w in zip(P.products, P.weights(), strict=True) if x.function == "cos"}
        found = {"M00": base[0, 0], "M01": base[0, 1], "MC": K.sum.weights()[0], "M11": base[1, 1]}
        found |= {"G0": -V[(1.0, 0.0)], "G1": -V[(0.0, 1.0)], "RATE": model.damping.rate}
        return {k: float(x) for k, x in found.items()}


def _velocity(constants: dict[str, float], state: State) -> Tensor:
    m = constants["M01"] + constants["MC"] * torch.cos(state.q[:, 0] - state.q[:, 1])
    a, b = torch.full_like(m, constants["M00"]), torch.full_like(m, constants["M11"])
    M = torch.stack([torch.stack([a, m], -1), torch.stack([m, b], -1)], -2)
    return torch.linalg.solve(M, state.p)
