"""Error against cost, for every way to step: `python benchmarks/work_precision.py [--quick] [--scenes ...] [--out F]`.

For each scene: discrete Lagrangians of order 1 to 6 and compositions of them (eager PyTorch). For the damped pendulum
and the double pendulum also, in C: a learned stepper with its distilled big steps, RK4 and DOP853 on the true equations
and on a neural ODE trained on the same data, and leapfrog on the true pendulum (the unit of cost). Needs scipy.

Error: largest |q − exact| at 4 times up to T, of motions from unseen starts (median, and 95 % of them), in units of q.
Cost: microseconds of one motion per unit of simulated time, best of several rounds in turn; evaluations beside it.
Everything here is float64 unless it says float32. Full run: several minutes on a quiet machine.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import math
import os
import platform
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from scipy.integrate import solve_ivp
from scipy.integrate._ivp import dop853_coefficients as dop
from torch import Tensor
from torch.func import jacrev, vmap
from tqdm import tqdm

from herglotz.data import simulate
from herglotz.export import compile_c, export_c
from herglotz.export.c_wrapper import FLAGS, compiler
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import State, Stepper, kahan_li, suzuki, yoshida
from herglotz.systems import scene, scene_names
from herglotz.training import FitConfig, fit, levenberg_marquardt
from herglotz.tune import TuneConfig, tune
from herglotz.tune.cost import Timed, measure_costs, timed_stepping

ROOT = Path(__file__).resolve().parents[1]
CHECKS = 4  # times at which errors are taken
LEARNED = {"damped_pendulum": (0, 0.5, 12.0), "double_pendulum": (1, 0.1, 2.4)}  # SYSTEM in C, h of the data, T
ORDERS = {"left": 1, "right": 1, "midpoint": 2, "midpoint_heun": 2, "trapezoid_heun": 2, "lobatto4": 4, "lobatto6": 6,
          "strang": 2, "strang_exponential": 2}  # fmt: skip


class Counted:
    """A discrete Lagrangian that counts its evaluations."""

    def __init__(self, L_d: Any):
        self.L_d, self.count = L_d, 0
        if hasattr(L_d, "partials"):
            self.partials = self._partials

    def __call__(self, *arguments: Tensor) -> Tensor:
        """The Lagrangian itself."""
        self.count += 1
        return self.L_d(*arguments)

    def _partials(self, *arguments: Any, **options: Any) -> Any:
        self.count += 1
        return self.L_d.partials(*arguments, **options)


def exact_motion(system: Any, start: State, T: float, checks: int = CHECKS) -> Tensor:
    """Positions (B, checks, n) at equal times up to T, by the scene's own flow in short steps."""
    state, out, parts = start, [], max(1, round(T / checks / system.h))
    for _ in range(checks):
        for _ in range(parts):
            state = State(*system.flow(*state, T / checks / parts))
        out.append(state.q)
    return torch.stack(out, 1)


def starts_of(system: Any, count: int, seed: int) -> State:
    generator = torch.Generator().manual_seed(seed)
    spans = []
    for low, high in (system.q_range, system.v_range):
        low, high = (torch.as_tensor(x, dtype=torch.float64).expand(count, system.dof) for x in (low, high))
        spans.append(low + (high - low) * torch.rand(count, system.dof, generator=generator, dtype=torch.float64))
    q, v = spans
    s = torch.zeros(count, dtype=torch.float64)
    return State(q, system.momentum(q, v, s), s)


def point(kind: str, setting: str, q: Tensor, truth: Tensor, us: float, spread: float, **more: Any) -> dict:
    e = (q.double() - truth).abs().flatten(1).amax(1).nan_to_num(nan=math.inf)
    errors = (float(e.median()), float(e.quantile(0.95, interpolation="higher")))
    median, high = (x if math.isfinite(x) else None for x in errors)
    return {
        "kind": kind,
        "setting": setting,
        "median": median,
        "q95": high,
        "us_per_time": us,
        "spread": spread,
        **more,
    }


def analytic(name: str, quick: bool) -> list[dict]:
    """Every rule and composition of a scene at several steps, eager; the time is that of a batch of starts, shared."""
    system = scene(name)
    count, T = (4, 8 * system.h) if quick else (8, 16 * system.h)
    start = starts_of(system, count, 1)
    truth = exact_motion(system, start, T)
    methods: list[tuple[str, Any, Any]] = [(r, system.L_d_rules[r], Stepper) for r in ORDERS if r in system.L_d_rules]
    if "strang" in system.L_d_rules:
        base = system.L_d_rules["strang"]
        some = ((yoshida, 4), (suzuki, 4), (yoshida, 6), (kahan_li, 6))
        methods += [
            (f"{make.__name__}{order}(strang)", base, lambda L, m=make, o=order: m(L, o)) for make, order in some
        ]
    if "midpoint_heun" in system.L_d_rules:
        L = system.L_d_rules["midpoint_heun"]
        methods += [(f"midpoint_heun, tol {t:g}", L, lambda L, t=t: Stepper(L, tol=t)) for t in (1e-4, 1e-8)]
    found = []
    for method, L_d, make in methods:
        for parts in (1, 4) if quick else (1, 2, 4):
            counted = Counted(L_d)
            stepper = make(counted)
            steps = round(T / system.h) * parts
            with torch.no_grad():
                began = time.perf_counter()
                q = stepper.rollout(*start, h=T / steps, steps=steps).q[:, steps // CHECKS :: steps // CHECKS]
                us = 1e6 * (time.perf_counter() - began) / T
            evaluations = counted.count / T
            setting = f"{method}, h {T / steps:.4g}"
            order = ORDERS.get(method.split(",")[0], int(method.split("(")[0][-1]) if "(" in method else 0)
            found.append(
                point(method, setting, q, truth, us, 0.0, order=order, evaluations_per_time=evaluations, batch=count)
            )
    return found


def train_neural_ode(data: Any, system: Any, h: float, width: int, iterations: int) -> Tensor:
    """Weights of a = net(sin q, cos q, v), two hidden layers, by Levenberg–Marquardt on exact states h apart.

    It is given what the learned stepper is not: the exact velocities. RK4 with four steps between samples.
    """
    n, m = system.dof, 3 * system.dof
    sizes = [(m, width), (width,), (width, width), (width,), (n, width)]
    generator = torch.Generator().manual_seed(0)
    first = [torch.randn(s, generator=generator, dtype=torch.float64) / s[0] ** 0.5 for s in sizes]
    first[4] = first[4] * 0.1
    theta = torch.cat([x.flatten() for x in first])
    v = system.velocity(data.q, data.p, data.s)
    y = torch.cat([data.q, v], -1)
    keep = torch.ones(len(y), dtype=torch.bool)
    keep[torch.tensor(data.offsets) + torch.tensor(data.lengths) - 1] = False
    rows = keep.nonzero()[:, 0]
    before, after = y[rows], y[rows + 1]

    def rhs(w: list[Tensor], y: Tensor) -> Tensor:
        q, v = y[..., :n], y[..., n:]
        x = torch.cat([q.sin(), q.cos(), v], -1)
        x = torch.tanh(torch.tanh(x @ w[0] + w[1]) @ w[2] + w[3])
        return torch.cat([v, x @ w[4].T], -1)

    def local(theta: Tensor, y: Tensor, y1: Tensor) -> Tensor:
        w = [x.reshape(s) for x, s in zip(theta.split([math.prod(s) for s in sizes]), sizes, strict=True)]
        k = h / 4
        for _ in range(4):
            k1 = rhs(w, y)
            k2 = rhs(w, y + k / 2 * k1)
            k3 = rhs(w, y + k / 2 * k2)
            k4 = rhs(w, y + k * k3)
            y = y + k / 6 * (k1 + 2 * (k2 + k3) + k4)
        return (y - y1) / h

    class Problem:
        sigma = 1e-8

        def cost(self, x: Tensor) -> Tensor:
            r = local(x, before, after) / self.sigma
            return r.square().sum() / 2 + (x - theta).square().sum() / 200

        def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            A, b = torch.eye(len(x), dtype=x.dtype) / 100, (x - theta) / 100
            cost = (x - theta).square().sum() / 200
            for rows in torch.arange(len(before)).split(512):
                r = local(x, before[rows], after[rows]).reshape(-1) / self.sigma
                J = vmap(jacrev(local), (None, 0, 0))(x, before[rows], after[rows]).reshape(-1, len(x)) / self.sigma
                A, b, cost = A + J.T @ J, b + J.T @ r, cost + r.square().sum() / 2
            return cost, A, b

    return levenberg_marquardt(Problem(), theta, max_iterations=iterations, rtol=1e-4).x


def dop853_source() -> str:
    """One attempted step of DOP853, with every coefficient written out, from the tables in scipy."""

    def total(weights: Any) -> str:
        return " + ".join(f"(real){float(w)!r} * k[{j}][d]" for j, w in enumerate(weights) if w)

    lines = ["static real attempt(const real *y, const real *f, real h, real tol, real *y_new, real *f_new) {",
             "  real k[12][D], z[D], e5 = 0, e3 = 0; int d;", "  memcpy(k[0], f, sizeof k[0]);"]  # fmt: skip
    for i in range(1, dop.N_STAGES):
        lines.append(f"  for (d = 0; d < D; d++) z[d] = y[d] + h * ({total(dop.A[i, :i])});\n  rhs(z, k[{i}]);")
    lines.append(f"  for (d = 0; d < D; d++) y_new[d] = y[d] + h * ({total(dop.B)});\n  rhs(y_new, f_new);")
    lines.append("  for (d = 0; d < D; d++) {\n    const real a = fabs(y[d]), b = fabs(y_new[d]);")
    lines.append("    const real scale = tol + tol * (a > b ? a : b);")
    lines.append(f"    const real u = ({total(dop.E5[:12])}) / scale, w = ({total(dop.E3[:12])}) / scale;")
    lines.append("    e5 += u * u; e3 += w * w;\n  }")
    lines.append("  if (e5 == 0 && e3 == 0) return 0;\n  return h * e5 / sqrt((e5 + (real)0.01 * e3) * D);\n}\n")
    return "\n".join(lines)


def build(folder: Path, header: Path, system: int, n: int, width: int = 1) -> Any:
    name = f"{header.stem}_{system}_{width}"
    here = folder / name
    here.mkdir()
    (here / "stepper.h").write_bytes(header.read_bytes())
    (here / "dop853_step.h").write_text(dop853_source())
    source = Path(__file__).with_suffix(".c")
    defines = [f"-DSYSTEM={system}", f"-DDOF={n}", f"-DWIDTH={width}", f"-I{here}", "-w"]
    subprocess.run([*compiler(), *FLAGS, *defines, "-shared", "-fPIC", "-o", here / "m.so", source, "-lm"], check=True)
    library = ctypes.CDLL(str(here / "m.so"))
    library.motions.restype = ctypes.c_long
    return library


def motions(library: Any, y: Tensor, T: float, adaptive: int, x: float) -> tuple[Tensor, int]:
    out = torch.empty(len(y), CHECKS, y.shape[1], dtype=torch.float64)
    pointers = (ctypes.c_void_p(y.data_ptr()), ctypes.c_void_p(out.data_ptr()))
    arguments = (ctypes.c_double(T / CHECKS), ctypes.c_int(adaptive), ctypes.c_double(x))
    count = library.motions(ctypes.c_long(len(y)), ctypes.c_long(CHECKS), *arguments, *pointers)
    return out[..., : y.shape[1] // 2], count


def learned(name: str, quick: bool, folder: Path) -> tuple[list[dict], dict]:
    """A learned stepper and what it is compared with, all in C."""
    system, (code, h, T) = scene(name), LEARNED[name]
    trajectories, iterations, count = (8, 15, 16) if quick else (40, 150, 64)
    data = simulate(system, trajectories=trajectories, steps=40, h=h, seed=0, keep_state=True)
    config = FitConfig(train_fraction=1.0, objective="residual", iterations=iterations)
    began = time.perf_counter()
    run = fit(data, config, progress=False)
    seconds = {"fit": time.perf_counter() - began}
    options = TuneConfig(
        multiples=(1, 2) if quick else (1, 2, 3), widths=(8,) if quick else (8, 16), starts=59,
        artefacts=("eager",), tolerances=(None,), rounds=1,
        iterations=20 if quick else 100, pairs=300 if quick else 1000,
    )  # fmt: skip
    began = time.perf_counter()
    tuned = tune(run, max_error=1.0, horizon=T, config=options, progress=False)
    seconds["tune"] = time.perf_counter() - began
    began = time.perf_counter()
    weights = train_neural_ode(data, system, h, 16, iterations)
    seconds["neural_ode"] = time.perf_counter() - began

    first = starts_of(system, count, 1000)
    second = State(*system.flow(*first, h))
    truth = exact_motion(system, second, T)
    entry = run.stepper.init(first.q, second.q, None, h)  # two positions, as a user has them
    entry = State(*(x.detach() for x in entry))
    v = system.velocity(*second)
    y = torch.cat([second.q, v], -1).contiguous()

    timed: list[Timed] = []
    rows: list[tuple] = []
    for c in tuned.candidates:
        steps = round(T / c.setting.h)
        if steps % CHECKS:
            continue
        for dtype in ("float64", "float32"):
            stepper = compile_c(c.model, h=c.setting.h, dtype=dtype)
            start = State(*(x.to(getattr(torch, dtype)).contiguous() for x in entry))
            q = stepper.rollout(*start, h=c.setting.h, steps=steps).q[:, steps // CHECKS :: steps // CHECKS]
            net = "own" if c.setting.width is None else f"w{c.setting.width}"
            timed.append(timed_stepping(stepper, start, c.setting.h, steps))
            rows.append((f"learned {dtype}", f"learned {net}, h {c.setting.h:.4g}, {dtype}", q, c.setting.h, None))
    if name == "damped_pendulum":
        model = ContactLagrangian(ModelConfig(rate=0.2, potential_width=0))
        stepper, exact = compile_c(model), State(second.q, second.p, second.s)
        for parts in (16, 32, 64, 128, 512, 2048):
            steps = parts * CHECKS
            q = stepper.rollout(*exact, h=T / steps, steps=steps).q[:, parts::parts]
            timed.append(timed_stepping(stepper, exact, T / steps, steps))
            rows.append(("C leapfrog, true equations", f"leapfrog, h {T / steps:.4g}", q, T / steps, 1.0 / (T / steps)))
    for dtype in ("float64", "float32"):
        header = export_c(run.model, folder / f"{name}_{dtype}.h", h=h, dtype=dtype)
        true, neural = build(folder, header, code, system.dof), build(folder, header, 9, system.dof, 16)
        w = weights.contiguous()
        neural.set_weights(ctypes.c_void_p(w.data_ptr()))
        for who, library in (("true equations", true), ("neural ODE", neural)):
            tolerances = [10.0**-k for k in range(2, 11 if dtype == "float64" else 6)]
            settings = [(1, x) for x in tolerances] + [(0, p) for p in (4, 6, 8, 12, 16, 24, 32, 48, 64, 128, 256)]
            for adaptive, x in settings:
                q, evaluations = motions(library, y, T, adaptive, x)
                method = f"DOP853, tol {x:.0e}" if adaptive else f"RK4, h {T / CHECKS / x:.3g}"
                few = y[:16].contiguous()
                # A timing repeats until it is long enough to read.
                per = max(1, 20000 // max(1, evaluations * 16 // count))

                def go(library=library, few=few, adaptive=adaptive, x=x, per=per) -> None:
                    for _ in range(per):
                        motions(library, few, T, adaptive, x)

                timed.append(Timed(go, per * 16))
                kind = f"{method.split(',')[0]}, {who}, {dtype}"
                rows.append((kind, f"{method}, {who}, {dtype}", q, T, evaluations / count / T))
    costs = measure_costs(timed, 2 if quick else 9)
    found = []
    for (kind, setting, q, unit, evaluations), cost in zip(rows, costs, strict=True):
        found.append(
            point(kind, setting, q, truth, cost.step_us / unit, cost.spread_us / unit, evaluations_per_time=evaluations)
        )
    found += python_dop853(system, second, truth, T, 4 if quick else 16)
    return found, {"seconds": seconds, "one_step_rms": run.metrics["one_step_rms"], "T": T, "h": h}


def python_dop853(system: Any, start: State, truth: Tensor, T: float, count: int) -> list[dict]:
    """DOP853 as scipy has it, in Python."""
    import numpy as np

    if system.name == "damped_pendulum":

        def rhs(t: float, y: Any) -> Any:  # noqa: ARG001
            return np.array([y[1], -math.sin(y[0]) - 0.2 * y[1]])
    else:

        def rhs(t: float, y: Any) -> Any:  # noqa: ARG001
            c, s = math.cos(y[0] - y[1]), math.sin(y[0] - y[1])
            f0, f1 = -s * y[3] ** 2 - 19.62 * math.sin(y[0]), s * y[2] ** 2 - 9.81 * math.sin(y[1])
            det = 2 - c * c
            return np.array([y[2], y[3], (f0 - c * f1) / det - 0.1 * y[2], (2 * f1 - c * f0) / det - 0.1 * y[3]])

    y = torch.cat([start.q, system.velocity(*start)], -1)[:count].numpy()
    found = []
    for tol in (1e-3, 1e-5, 1e-7):
        began, out, evaluations = time.perf_counter(), [], 0
        for one in y:
            times = [T * (k + 1) / CHECKS for k in range(CHECKS)]
            sol = solve_ivp(rhs, (0, T), one, "DOP853", times, rtol=tol, atol=tol)
            out.append(torch.from_numpy(sol.y[: system.dof].T.copy()))
            evaluations += sol.nfev
        us = 1e6 * (time.perf_counter() - began) / count / T
        setting = f"scipy DOP853, tol {tol:.0e}"
        more = {"evaluations_per_time": evaluations / count / T}
        found.append(point("scipy DOP853, true equations", setting, torch.stack(out), truth[:count], us, 0.0, **more))
    return found


def cheapest(points: list[dict], words: str, error: float) -> dict | None:
    """The cheapest point of this kind whose median error is no larger."""
    good = [p for p in points if words in p["kind"] and p["median"] is not None and p["median"] <= error]
    return min(good, key=lambda p: p["us_per_time"], default=None)


def headline(points: list[dict]) -> list[dict]:
    """At the error of each learned setting on its own front: cost of the others over its cost."""
    rows = []
    mine = [p for p in points if p["kind"].startswith("learned") and p["median"] is not None]
    best = math.inf
    for p in sorted(mine, key=lambda p: p["us_per_time"]):
        if p["median"] >= best:
            continue
        best = p["median"]
        row: dict[str, Any] = {"setting": p["setting"], "median": p["median"], "us_per_time": p["us_per_time"]}
        for label, words in (
            ("neural ODE", "neural ODE"),
            ("DOP853 in C", "DOP853, true"),
            ("RK4 in C", "RK4, true"),
            ("DOP853 in scipy", "scipy"),
            ("leapfrog in C", "leapfrog"),
        ):
            other = cheapest([q for q in points if words != "DOP853, true" or "scipy" not in q["kind"]], words, best)
            row[label] = None if other is None else other["us_per_time"] / p["us_per_time"]
        reached = [q["median"] for q in points if "neural ODE" in q["kind"] and q["median"] is not None]
        row["best error of the neural ODE"] = min(reached, default=None)
        rows.append(row)
    return rows


def front(points: list[dict]) -> list[dict]:
    kept: list[dict] = []
    for p in sorted((p for p in points if p["median"] is not None), key=lambda p: p["us_per_time"]):
        if not kept or p["median"] < kept[-1]["median"]:
            kept.append(p)
    return kept


def draw(scenes: dict[str, list[dict]], path: Path) -> None:
    from herglotz.plots.style import INK, SERIES, new_figure, save_figure, styled

    with styled():
        columns = min(3, len(scenes))
        rows = -(-len(scenes) // columns)
        figure = new_figure(5.2 * columns, 4.2 * rows, "Error against cost")
        axes = figure.subplots(rows, columns, squeeze=False).flat
        for ax, (name, points) in zip(axes, scenes.items(), strict=False):
            for k, kind in enumerate(dict.fromkeys(p["kind"] for p in points)):
                mine = sorted((p for p in points if p["kind"] == kind and p["median"]), key=lambda p: p["us_per_time"])
                style = {
                    "color": SERIES[k % len(SERIES)],
                    "marker": "os^Dv"[k // len(SERIES) % 5],
                    "ms": 3.5,
                    "lw": 0.8,
                }
                if kind.startswith("learned"):
                    style |= {"lw": 0, "ms": 5}
                ax.plot([p["us_per_time"] for p in mine], [p["median"] for p in mine], label=kind, **style)
            best = front(points)
            ax.step([p["us_per_time"] for p in best], [p["median"] for p in best], where="post", color=INK, lw=1.5)
            ax.set(xscale="log", yscale="log", title=name, xlabel="µs per unit of time", ylabel="median error")
            ax.legend(fontsize=5.5)
        save_figure(figure, path)


def leapfrog_unit(result: dict[str, Any]) -> None:
    """Every cost also in steps of C leapfrog, where one was timed in this run."""
    points = [p for points in result["scenes"].values() for p in points]
    steps = [p["us_per_time"] / p["evaluations_per_time"] for p in points if "leapfrog" in p["kind"]]
    if steps:
        result["leapfrog_step_us"] = statistics.median(steps)
        for p in points:
            p["leapfrogs_per_time"] = p["us_per_time"] / result["leapfrog_step_us"]


def main(argv: list[str] | None = None) -> dict:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a minute: small fits, few settings")
    parser.add_argument("--scenes", default=None, help="with commas (default: all)")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "work_precision.json")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    names = arguments.scenes.split(",") if arguments.scenes else list(scene_names())
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT).stdout
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "threads": torch.get_num_threads()}
    result: dict[str, Any] = {
        "commit": commit.strip(), "machine": machine, "torch": torch.__version__, "quick": arguments.quick,
        "scenes": {}, "headline": {}, "learned": {},
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder, tqdm(names, disable=None) as bar:
        for name in bar:
            bar.set_postfix_str(name)
            points = [] if name not in scene_names() else analytic(name, arguments.quick)
            if name in LEARNED:
                more, notes = learned(name, arguments.quick, Path(folder))
                points += more
                result["headline"][name], result["learned"][name] = headline(more), notes
            result["scenes"][name] = points
    leapfrog_unit(result)
    for name, points in result["scenes"].items():
        print(f"{name}: the front")
        for p in front(points):
            print(f"  {p['us_per_time']:>10.3g} µs/time  {p['median']:>8.2g}  {p['setting']}")
        for row in result["headline"].get(name, []):
            text = ", ".join(f"{k} {v:.3g}" for k, v in row.items() if isinstance(v, float))
            print(f"  at {row['setting']}: {text}; not reached: {[k for k, v in row.items() if v is None]}")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    draw(result["scenes"], arguments.out.with_suffix(".png"))
    return result


if __name__ == "__main__":
    main()
