"""The exported step in control: `python benchmarks/control.py [--quick] [--only PART ...] [--out FOLDER]`.

`nlp`: the swing-up of `examples/mpc_swing_up.py` by IPOPT over 50 intervals of 0.05 s, each of 8 steps; the same step
as the file for CasADi (the horizon in one call) and as CasADi's own expressions. `loop`: a real-time iteration
(`rti.c` of `examples/real_time_iteration`) in closed loop: the true plant of the example from random starts, whose
positions are read with the noise of the recordings, and a Kalman filter on the learned step that makes states of them.
One thread, processor time; what is compared is timed in turn within each repeat, and a ratio is one of a single repeat.
Writes control.json and control.md.
"""

from __future__ import annotations

import ctypes
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from herglotz.codegen.c_compiler import compiler
from herglotz.export import compile_c, export_casadi
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State
from herglotz.stepping.filter import Belief, KalmanFilter, Noise

# The learned model. The numbers are those that the example learns of its recordings; the fit is not repeated.
H = 0.00625  # s: the model's own step
FACTOR = ((1.0, 0.0), (0.00031584926745, 0.23984877))  # C of the mass m = C Cᵀ
COUPLING, STIFFNESS, RATE = 0.11501273180, 1.12807918135, 0.00105678298
VISCOUS, DRAG = (0.30569501943, 0.00761698943), -0.00528029567
INPUTS = (0.76955898360, 0.00029280290)  # input map of the friction term
ITERATIONS = 3  # of Newton from q1 = q0: a fourth changes a step by rounding alone

N, STEPS = 50, 8  # intervals, and steps in one
INTERVAL = STEPS * H  # s
UPRIGHT, WEIGHT = np.array([0.0, np.pi, 0.0, 0.0, 0.0]), np.array([1.0, 2.0, 0.05, 0.5, 0.0])
FORCE, FORCE_WEIGHT, LAST = 12.0, 0.003, 20.0
TRACK, BARRIER = 0.9, 10.0  # m to either side; the barrier's weight
MISS = 1e-3  # m: what the model misses in an interval
SENSOR = 1e-3  # m and rad: the noise of positions, as in the recordings of the example
NOISE = Noise((1.04e-3, 1.06e-3), (4.5e-4, 1.0e-4), adaptation=0.02)  # of `noise_of` for its fit
START = (SENSOR, SENSOR, 0.5, 0.15)  # deviations of x, θ and their momenta over the starts
NEAR = 0.1  # rad from upright
FLAGS = ("-O3", "-march=native", "-fPIC", "-shared")
Row = dict[str, Any]
Plant = Callable[..., np.ndarray]


def model() -> ContactLagrangian:
    """The model."""
    config = ModelConfig(
        angles=(False, True), level="forced", scale=(0.55, 2.8), speed=(2.4, 8.5), stiffness=(0.0, STIFFNESS),
        tilt=(0.0, 0.0), rate=RATE, potential_width=0, inputs=1, features=("cos(q2) v1 v2",), drag=("q1 v1",),
    )  # fmt: skip
    made = ContactLagrangian(config)
    double: Any = {"dtype": torch.float64}
    numbers = {
        "kinetic.base.log_diagonal": torch.tensor(FACTOR[1][1], **double).log(),
        "kinetic.base.off_diagonal": torch.tensor(FACTOR[1][0], **double),
        "kinetic.sum.coefficient": torch.tensor(COUPLING, **double),
        "friction.viscous": torch.tensor(VISCOUS, **double),
        "friction.input_map": torch.tensor(INPUTS, **double),
        "drag.coefficient": torch.tensor(DRAG, **double),
    }
    with torch.no_grad():
        for name, value in numbers.items():
            parameter = made.get_parameter(name)
            parameter.copy_(value.reshape(parameter.shape))
    return made


def _equation(q0: Any, p0: Any, s0: Any, q1: Any, u: Any, h: Any) -> tuple[Any, Any, Any]:
    """D1 L_d + F⁻ + c p0, p1 = D2 L_d + F⁺ and s1 = s0 + L_d, of SX symbols."""
    C, delta, middle = ca.DM(FACTOR), q1 - q0, (q0 + q1) / 2
    v, c = delta / h, ca.exp(-RATE * h)
    K = ca.dot(v, C @ (C.T @ delta)) / 2 + h * COUPLING * ca.cos(middle[1]) * v[0] * v[1]
    V0, V1 = (STIFFNESS * (1 - ca.cos(q[1])) for q in (q0, q1))
    L = (c - 1) * (s0 - h / 2 * V0) + ca.sqrt(c) * K - h / 2 * (V0 + V1)
    force = ca.DM(INPUTS) * u - ca.DM(VISCOUS) * v - ca.vertcat(DRAG * middle[0] * v[0], 0)
    return ca.gradient(L, q0) + c * h / 2 * force + c * p0, ca.gradient(L, q1) + h / 2 * force, s0 + L


def sx_steps() -> dict[str, ca.Function]:
    """The step (x, u, h) → x1 in CasADi alone: Newton unrolled in SX, and CasADi's own `fast_newton` on SX."""
    q0, q1, p0 = (ca.SX.sym(name, 2) for name in ("q0", "q1", "p0"))
    s0, u, h = (ca.SX.sym(name) for name in ("s0", "u", "h"))
    residual, p1, s1 = _equation(q0, p0, s0, q1, u, h)
    x = ca.vertcat(q0, p0, s0)
    newton = ca.Function("newton", [q1, x, u, h], [q1 - ca.inv(ca.jacobian(residual, q1)) @ residual])
    end = ca.Function("end", [q1, x, u, h], [ca.vertcat(q1, p1, s1)])
    q = q0
    for _ in range(ITERATIONS):
        q = newton(q, x, u, h)
    unrolled = ca.Function("unrolled", [x, u, h], [end(q, x, u, h)])
    root = ca.rootfinder("root", "fast_newton", ca.Function("residual", [q1, x, u, h], [residual]), {"abstol": 1e-13})
    x, u, h = ca.MX.sym("x", 5), ca.MX.sym("u"), ca.MX.sym("h")
    return {"unrolled": unrolled, "rootfinder": ca.Function("found", [x, u, h], [end(root(x[:2], x, u, h), x, u, h)])}


def built(source: Path, *more: str) -> Path:
    """A C file as a library beside it."""
    library = source.with_suffix(".so")
    subprocess.run([*compiler(), *FLAGS, *more, str(source), "-o", str(library), "-lm"], check=True)
    return library


def repeated(step: ca.Function) -> ca.Function:
    """(x, u) → x after an interval, by single steps; of N columns."""
    x, u = ca.MX.sym("x", 5), ca.MX.sym("u")
    end = x
    for _ in range(STEPS):
        end = step(end, u, H)
    return ca.Function("ahead", [x, u], [end]).map(N)


def problem(ahead: ca.Function, **options: Any) -> tuple[dict[str, ca.MX], dict[str, Any]]:
    """The problem of optimal control, and the solver's options: the Hessian is that of the cost."""
    X, U, start = ca.MX.sym("X", 5, N + 1), ca.MX.sym("U", 1, N), ca.MX.sym("start", 5)
    distance = ca.DM(WEIGHT).T @ (X - UPRIGHT) ** 2
    cost = ca.sum2(distance) + LAST * distance[-1] + FORCE_WEIGHT * ca.sumsqr(U)
    unknowns = ca.veccat(X, U)
    gaps = ca.veccat(X[:, 0] - start, ahead(X[:, :-1], U) - X[:, 1:])
    scale, multipliers = ca.MX.sym("scale"), ca.MX.sym("multipliers", gaps.shape[0])
    hessian = ca.triu(scale * ca.hessian(cost, unknowns)[0])
    options["hess_lag"] = ca.Function("hess_lag", [unknowns, start, scale, multipliers], [hessian])
    options |= {"ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-4}, "print_time": False}
    return {"x": unknowns, "f": cost, "g": gaps, "p": start}, options


def solver(ahead: ca.Function) -> ca.Function:
    """IPOPT on the problem with this interval."""
    nlp, options = problem(ahead)
    return ca.nlpsol("solver", "ipopt", nlp, options)


def generated(ahead: ca.Function, path: Path) -> ca.Function:
    """The same with cost, gaps and their derivatives in C that CasADi generates."""
    source = Path(solver(ahead).generate_dependencies(path.name))
    source = source.rename(path) if source.resolve() != path.resolve() else path
    own = {name: ca.external(f"nlp{name}", str(built(source))) for name in ("", "_grad_f", "_jac_g")}
    _, options = problem(ahead, grad_f=own["_grad_f"], jac_g=own["_jac_g"])
    return ca.nlpsol("solver", "ipopt", own[""], options)


def solve(solver: ca.Function) -> tuple[float, float, float]:
    """Seconds of processor time, those in the problem's functions, and the least cost."""
    bound = np.full((5, N + 1), np.inf)
    bound[0] = TRACK
    bound = np.concatenate([bound.ravel("F"), np.full(N, FORCE)])
    guess = np.concatenate([np.linspace(np.zeros(5), UPRIGHT, N + 1).ravel(), np.full(N, 0.1)])
    began = time.process_time()
    found = solver(x0=guess, p=np.zeros(5), lbx=-bound, ubx=bound, lbg=0, ubg=0)
    took, stats = time.process_time() - began, solver.stats()
    assert stats["success"], stats["return_status"]
    return took, sum(x for key, x in stats.items() if key.startswith("t_proc_nlp")), float(found["f"])


def exported(folder: Path) -> tuple[str, ca.Function]:
    """The compiled file for CasADi, and all intervals by its one call."""
    library = str(built(export_casadi(model(), folder / "cart.c", h=H), f"-Dcart_HORIZON={N}"))
    shoot, X, U = ca.external("cart_shoot", library), ca.MX.sym("X", 5, N), ca.MX.sym("U", 1, N)
    return library, ca.Function("ahead", [X, U], [shoot(X, U, INTERVAL)])


def nlp(quick: bool, folder: Path) -> list[Row]:
    """The whole solution and its functions, ours and others in turn."""
    library, shoot = exported(folder)
    hold, x, u = ca.external("cart_hold", library), ca.MX.sym("x", 5), ca.MX.sym("u")
    own = sx_steps()
    forms = {
        "ours": solver(shoot),
        "ours, 50 calls of a hold": solver(ca.Function("ahead", [x, u], [hold(x, u, INTERVAL)]).map(N)),
        "ours, 8 calls of a step": solver(repeated(ca.external("cart_step", library))),
        "SX, fast_newton": solver(repeated(own["rootfinder"])),
        "SX, Newton unrolled": solver(repeated(own["unrolled"])),
        "C of SX, fast_newton": generated(repeated(own["rootfinder"]), folder / "found.c"),
        "C of SX, Newton unrolled": generated(repeated(own["unrolled"]), folder / "unrolled.c"),
    }
    taken = [{name: solve(form) for name, form in forms.items()} for _ in range(1 if quick else 5)]
    costs = [cost for once in taken for _, _, cost in once.values()]
    assert max(costs) - min(costs) < 1e-6 * max(costs), costs  # the same problem
    rows = []
    for name in forms:
        whole, inside = ([once[name][k] / once["ours"][k] for once in taken] for k in (0, 1))
        row = {"what": f"swing-up, {name}", "ms": 1e3 * statistics.median(once[name][0] for once in taken)}
        target = None if name.startswith("ours") else 1.5 if name.startswith("C of") else 5.0
        rows.append(row | {"whole": whole, "functions": inside, "target": target})
    return rows


class Controller(ctypes.Structure):
    """`rti` of `rti.c`."""

    _fields_ = [
        ("H", ctypes.c_double), ("X", ctypes.c_double * 5), ("Q", ctypes.c_double * 5), ("E", ctypes.c_double * 5),
        ("R", ctypes.c_double), ("U", ctypes.c_double), ("B", ctypes.c_double * 5), ("barrier", ctypes.c_double),
        ("near", ctypes.c_double), ("x", ctypes.c_double * (5 * (N + 1))),
        ("u", ctypes.c_double * N), ("K", ctypes.c_double * (5 * N)), ("k", ctypes.c_double * N),
        ("damping", ctypes.c_double), ("cost", ctypes.c_double),
    ]  # fmt: skip


def plant() -> Plant:
    """The true plant: the first cells of the example."""
    text = (harness.ROOT / "examples" / "mpc_swing_up.py").read_text(encoding="utf-8")
    known: dict[str, Any] = {}
    exec(text[: text.index("# Four recordings")], known)
    return known["plant"]


class Watched:
    """The plant, and what a filter knows of it from noisy positions."""

    def __init__(self, true: Plant, kalman: KalmanFilter, z: np.ndarray, make: np.random.Generator):
        self.true, self.kalman, self.z, self.make = true, kalman, z, make  # z = (x, θ, x′, θ′)
        rest = torch.zeros(2, dtype=torch.float64)
        self.belief: Belief = kalman.start(State(self._read(), rest, rest[0]), rest.new_tensor(START))

    def move(self, force: float) -> None:
        """An interval under a force, and the sample at its end."""
        belief, u = self.belief, torch.tensor([force], dtype=torch.float64)
        for _ in range(STEPS):
            belief = self.kalman.predict(belief, H, u)
        self.z = self.true(self.z, force, INTERVAL, 6)
        self.belief, _ = self.kalman.update(belief, self._read())

    def _read(self) -> Tensor:
        return torch.as_tensor(self.z[:2] + SENSOR * self.make.normal(size=2))


def closed(library: ctypes.CDLL, seen: Watched, count: int) -> dict[str, Any]:
    """`count` samples: the angle after each, the largest |x|, ms of both phases, and iterations before the first.

    Two samples without a force tell the filter the velocities.
    """
    it, force = Controller(H=INTERVAL, R=FORCE_WEIGHT, U=FORCE, barrier=BARRIER, near=MISS / TRACK), ctypes.c_double()
    it.B[0] = TRACK
    it.X[:], it.Q[:], it.E[:] = UPRIGHT, WEIGHT, LAST * WEIGHT
    it.u[:] = [0.1] * N

    def fed_back() -> int:
        q, p, _ = seen.belief.state
        return library.rti_feedback(ctypes.byref(it), (ctypes.c_double * 5)(*q, *p, 0.0), ctypes.byref(force))

    for _ in range(2):
        seen.move(0.0)
    failed, first = fed_back(), 0  # the first motion: no law yet
    while max(map(abs, it.x[::5])) > TRACK and not failed:
        failed, first = library.rti_prepare(ctypes.byref(it)) | fed_back(), first + 1
    path, ms = [], []
    for _ in range(count):
        times = [time.perf_counter()]
        failed |= library.rti_prepare(ctypes.byref(it))
        times.append(time.perf_counter())
        failed |= fed_back()
        times.append(time.perf_counter())
        failed |= library.rti_shift(ctypes.byref(it))
        assert not failed
        seen.move(force.value)
        path.append(seen.z)
        ms.append([1e3 * (b - a) for a, b in pairwise(times)])
    x, angles = np.array(path)[:, :2].T
    return {"angles": angles, "widest": float(abs(x).max()), "ms": np.array(ms), "first": first}


def from_random_starts(library: ctypes.CDLL, starts: int, count: int) -> list[dict[str, Any]]:
    """`closed` from so many starts."""
    true, kalman = plant(), KalmanFilter(model(), NOISE, stepper=compile_c(model(), h=H))
    draw, make, found = np.random.default_rng(0), np.random.default_rng(1), []
    for _ in range(starts):
        z = np.array([draw.uniform(-0.5, 0.5), draw.uniform(-np.pi, np.pi), *draw.normal(size=2) * [0.5, 2.0]])
        found.append(closed(library, Watched(true, kalman, z, make), count))
    return found


def loop(quick: bool, folder: Path) -> list[Row]:
    """From random starts: up for 10 s after at most 5 s, and the time of an iteration."""
    export_casadi(model(), folder / "model.c", h=H, name="model")
    source = folder / "rti.c"
    source.write_text((harness.ROOT / "examples" / "real_time_iteration" / "rti.c").read_text(encoding="utf-8"))
    found = from_random_starts(ctypes.CDLL(str(built(source))), 1 if quick else 100, round(15.0 / INTERVAL))
    off = [abs((one["angles"] % (2 * np.pi)) - np.pi) for one in found]
    last = [np.flatnonzero(x >= NEAR)[-1] + 1 if (x >= NEAR).any() else 0 for x in off]  # samples until it stays up
    up = sum(int(INTERVAL * k <= 5.0) for k in last)
    ms = np.concatenate([one["ms"] for one in found])
    return [
        {"what": f"up for 10 s, of {len(found)} random starts", "value": up, "target": f"{len(found)}"},
        {"what": "last time not within 0.1 rad of upright, s", "value": INTERVAL * max(last)},
        {"what": "farthest from upright in the last 10 s, rad", "value": float(max(x[-200:].max() for x in off))},
        {"what": "widest way of the cart, m", "value": max(one["widest"] for one in found), "target": f"<= {TRACK:g}"},
        {"what": "iterations before the first sample, at most", "value": max(one["first"] for one in found)},
        {"what": "an iteration, ms (median; clock)", "value": float(np.median(ms.sum(1))), "target": "<= 1"},
        {"what": "of it the feedback, ms (median; clock)", "value": float(np.median(ms[:, 1]))},
        {"what": "an iteration, ms (99 of 100; clock)", "value": float(np.quantile(ms.sum(1), 0.99))},
    ]


PARTS = {"nlp": nlp, "loop": loop}


def table(rows: list[Row]) -> str:
    """Markdown: the solutions, then single numbers."""
    solved, other = [r for r in rows if "whole" in r], [r for r in rows if "whole" not in r]
    text = []
    if solved:
        span = lambda x: f"{statistics.median(x):.2f}× ({min(x):.2f} … {max(x):.2f})"  # noqa: E731
        cells = [(r["what"], f"{r['ms']:.0f}", span(r["whole"]), span(r["functions"]),
                  "" if r["target"] is None else f">= {r['target']:g}") for r in solved]  # fmt: skip
        head = ("what", "ms a solution", "over ours", "functions alone, over ours", "target")
        text += [*harness.table(head, cells), ""]
    cells = [(r["what"], f"{r['value']:.3g}", r.get("target", ""), r.get("note", "")) for r in other]
    return "\n".join([*text, *(harness.table(("what", "measured", "target", ""), cells) if cells else [])])


def main(argv: list[str] | None = None) -> None:
    """Measure the parts, and write both files."""
    parser = harness.parser(__doc__, quick=True)
    parser.add_argument("--only", nargs="*", choices=list(PARTS), help="parts to run")
    arguments = parser.parse_args(argv)
    path = harness.json_file(arguments, "control")
    parts = harness.load(path, {"parts": {}})["parts"]
    for name in arguments.only or PARTS:
        with tempfile.TemporaryDirectory(prefix="herglotz-bench-") as folder:
            parts[name] = PARTS[name](arguments.quick, Path(folder))
        rows = [row for part in PARTS for row in parts.get(part, [])]
        harness.store(path, {**harness.conditions("casadi"), "parts": parts}, table(rows))
    print(path.with_suffix(".md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
