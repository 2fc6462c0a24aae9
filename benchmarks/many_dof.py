"""Several degrees of freedom and known structure: `python benchmarks/many_dof.py [--seeds 5] [--only WORD …]`.

Positions only, simulated to about 1e-13, float64. Each row names what the fit was told (`features`, `alike`, …);
the rest is the default of `fit`. Errors are of free runs from unseen starts, each given by its first two exact
positions; a relative RMS is over the RMS of the motion itself. Results are added to `results/many_dof.json` row by row.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data import simulate
from herglotz.data.files import write_atomically
from herglotz.models import ContactLagrangian
from herglotz.plots.style import new_figure, save_figure, styled
from herglotz.scenes import scene
from herglotz.scenes.reference import reference_flow
from herglotz.scenes.scene import Scene
from herglotz.stepping import Event, State, Stepper
from herglotz.theory import boundary_value
from herglotz.training import FitConfig, fit

RESULTS = Path(__file__).resolve().parent / "results"
HINGES = torch.tensor(
    [[0.2, -0.1], [-0.1, 0.1]], dtype=torch.float64
)  # two viscous hinges 0.1, angles from the vertical


def hinged() -> Scene:
    """The double pendulum with viscous friction 0.1 in each of its two hinges instead of one damping rate."""
    free = scene("double_pendulum", gamma=0.0)

    def slopes(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        v = free.velocity(q, p, s)
        twist = torch.sin(q[..., 0] - q[..., 1]) * v[..., 0] * v[..., 1]
        weight = 9.81 * torch.sin(q)
        force = torch.stack([-twist - 2 * weight[..., 0], twist - weight[..., 1]], -1)
        return v, force - v @ HINGES, torch.zeros_like(s)

    return replace(free, name="hinges", flow=lambda q, p, s, h: reference_flow(slopes, q, p, s, h))


def charged() -> Scene:
    """Kepler's problem with drag in a magnetic field across the plane: q̈ = −q/|q|³ + 0.8 (q̇₂, −q̇₁) − 0.05 q̇."""

    def slopes(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        turned = torch.stack([p[..., 1], -p[..., 0]], -1)
        return p, 0.8 * turned - 0.05 * p - q * (q * q).sum(-1, keepdim=True) ** -1.5, torch.zeros_like(s)

    return replace(scene("kepler"), name="charged", flow=lambda q, p, s, h: reference_flow(slopes, q, p, s, h))


@dataclass(frozen=True)
class Row:
    """One case: data, what the fit is told, and its target."""

    name: str
    make: Callable[[], Scene]
    h: float
    trajectories: int
    steps: int  # of each trajectory
    told: FitConfig
    test_steps: int
    relative: bool
    target: float


def told(**settings: Any) -> FitConfig:
    """Train on everything; the model is judged on other trajectories."""
    return FitConfig(**{"train_fraction": 1.0, "objective": "residual", **settings})


LINKS: dict[str, Any] = {"features": ("pendulums",), "order": 4}
CENTRAL = told(level="linear", features=("central",), alike=True, order=4)
SPRINGS = told(level="linear", features=("chain",), alike=True, order=4)
PLAIN = told(objective="auto")
JOINTS = told(level="forced", coupled=True, **LINKS)
ROWS = [
    Row("double pendulum, hinges, nothing told", hinged, 0.02, 20, 50, PLAIN, 50, False, 1e-4),
    Row("double pendulum, hinges, 20 × 50", hinged, 0.02, 20, 49, JOINTS, 50, False, 1e-4),
    Row("double pendulum, hinges, 100 × 100", hinged, 0.02, 100, 99, JOINTS, 50, False, 1e-4),
    Row("double pendulum, one rate, 20 × 50", lambda: scene("double_pendulum"), 0.02, 20, 49,
        told(level="linear", **LINKS), 50, False, 1e-4),
    Row("Kepler, drag, nothing told", lambda: scene("kepler"), 0.02, 20, 100, PLAIN, 200, True, 1e-4),
    Row("charged particle, drag, nothing told", charged, 0.02, 20, 100, PLAIN, 200, True, 1e-4),
    Row("Kepler, drag", lambda: scene("kepler"), 0.02, 20, 100, CENTRAL, 200, True, 1e-4),
    Row("Kepler, drag, larger step", lambda: scene("kepler"), 0.05, 20, 100, CENTRAL, 200, True, 1e-4),
    Row("Kepler, drag, larger step, 4 model steps", lambda: scene("kepler"), 0.05, 5, 60,
        replace(CENTRAL, objective="trajectory", substeps=4), 200, True, 1e-4),
    Row("chain of 10, nothing told", lambda: scene("chain", masses=10), 0.1, 10, 40, PLAIN, 200, True, 1e-4),
    Row("chain of 10", lambda: scene("chain", masses=10), 0.1, 10, 40, SPRINGS, 200, True, 1e-4),
    Row("chain of 10, larger step", lambda: scene("chain", masses=10), 0.2, 10, 40, SPRINGS, 200, True, 1e-4),
    Row("chain of 10, larger step, 2 model steps", lambda: scene("chain", masses=10), 0.2, 4, 30,
        replace(SPRINGS, objective="trajectory", substeps=2), 200, True, 1e-4),
    Row("chain of 32", lambda: scene("chain", masses=32), 0.1, 2, 20, SPRINGS, 20, True, 1e-4),
]  # fmt: skip


def free_run(model: ContactLagrangian, row: Row, of: Scene, seed: int) -> tuple[float, float]:
    """RMS and median of |error| over a free run from 10 unseen starts."""
    n, m = of.dof, row.told.substeps
    q = simulate(of, trajectories=10, steps=row.test_steps + 1, h=row.h, seed=1000 + seed).q.reshape(10, -1, n)
    stepper = Stepper(model)
    with torch.no_grad():
        if m == 1:
            start = stepper.init(q[:, 0], q[:, 1], None, row.h)
        else:  # the model's own motion from the first position to the second
            curve = boundary_value(model, q[:, 0], q[:, 1], q.new_zeros(len(q)), h=row.h / m, steps=m, throw=True)
            start = State(curve.q[:, -1], curve.p[:, -1], curve.s[:, -1])
        out = stepper.rollout(*start, h=row.h / m, steps=m * row.test_steps)
    size = float(q.square().mean().sqrt()) if row.relative else 1.0
    error = (out.q[:, ::m] - q[:, 1:]) / size
    return float(error.square().mean().sqrt()), float(error.abs().median())


def motion(row: Row, seed: int) -> dict:
    """One fit of one row."""
    of = row.make()
    data = simulate(of, trajectories=row.trajectories, steps=row.steps, h=row.h, seed=seed)
    began = time.process_time()
    run = fit(data, replace(row.told, seed=seed), progress=False)
    cpu = time.process_time() - began
    rms, median = free_run(run.model, row, of, seed)
    return {"rms": rms, "median": median, "one_step": run.metrics["one_step_rms"], "cpu_s": cpu,
            "parameters": run.metrics["parameters"]}  # fmt: skip


def falling(seed: int) -> dict:
    """The parachute at the affine level: terminal speed and landing time, relative errors."""
    of, h = scene("parachute"), 0.05
    data = simulate(of, trajectories=10, steps=120, h=h, seed=seed)
    began = time.process_time()
    run = fit(data, told(level="affine", features=("1",), alike=True, damping_width=0, correction_width=0, seed=seed),
              progress=False)  # fmt: skip
    cpu = time.process_time() - began
    q, v, s = torch.tensor([[100.0]]).double(), torch.tensor([[-5.0]]).double(), torch.zeros(1).double()
    p = of.momentum(q, v, s)
    stepper = Stepper(run.model)
    start = stepper.init(q, of.flow(q, p, s, h)[0], None, h)
    with torch.no_grad():
        speed = stepper.rollout(*start, h=h, steps=800).q.diff(dim=1)[0, -1, 0] / h
        landed = float(stepper.rollout(*start, h=h, steps=400, events=(Event(lambda x: x.q[..., 0]),)).events[0].t) + h
    low, high = 1.0, 30.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if float(of.flow(q, p, s, middle)[0]) > 0 else (low, middle)
    exact = -((of.parameters["g"] / of.parameters["lam"]) ** 0.5)
    return {"terminal": abs(float(speed) / exact - 1), "landing": abs(landed / low - 1), "cpu_s": cpu,
            "parameters": run.metrics["parameters"]}  # fmt: skip


def braking(seed: int) -> dict:
    """Quadratic drag alone at the affine level: the coefficient λ and the position after 200 steps, relative errors.

    The fitted coefficient is that of the rule of order 2, apart from λ by O(h²). A second fit to every other sample
    tells how much: (4 λ(h) − λ(2h)) / 3 is λ at h → 0 (Richardson).
    """
    of, h = scene("quadratic_drag"), 0.05
    data = simulate(of, trajectories=10, steps=120, h=h, seed=seed)
    settings = told(level="affine", alike=True, damping_width=0, correction_width=0, seed=seed)
    began = time.process_time()
    run, coarse = (fit(data.thinned(every), settings, progress=False) for every in (1, 2))
    cpu = time.process_time() - began
    row = Row("", scene, h, 0, 0, PLAIN, 200, True, 0.0)  # type: ignore[arg-type]
    drag, double = (float(r.model.get_parameter("damping.drag").detach()[0]) / 2 for r in (run, coarse))
    wanted = of.parameters["lam"]
    return {"coefficient": abs(drag / wanted - 1), "coefficient, h → 0": abs((4 * drag - double) / 3 / wanted - 1),
            "rms": free_run(run.model, row, of, seed)[0], "cpu_s": cpu,
            "parameters": run.metrics["parameters"]}  # fmt: skip


FALLS = {"parachute, falling": (falling, ("terminal", "landing"), 1e-5),
         "quadratic drag": (braking, ("coefficient", "coefficient, h → 0", "rms"), 1e-5)}  # fmt: skip


def table(results: dict) -> str:
    """One line a figure: median, range over the seeds, target."""
    lines = [
        "| case | h | figure | median | min … max | seeds | parameters | fit, CPU s | target | met | commit |",
        "|---" * 11 + "|",
    ]
    for name, row in results.items():
        for figure_, target in row["figures"].items():
            values = [x[figure_] for x in row["seeds"]]
            middle = statistics.median(values)
            cpu = statistics.median(x["cpu_s"] for x in row["seeds"])
            spread = f"{min(values):.1e} … {max(values):.1e}"
            met = "yes" if middle <= target else "**no**"
            cells = [name, row["h"], figure_, f"{middle:.1e}", spread, len(values), row["seeds"][0]["parameters"],
                     f"{cpu:.0f}", f"{target:g}", met, row["commit"]]  # fmt: skip
            lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def draw(results: dict, path: Path) -> None:
    """Every seed's figure beside its target."""
    names = [(name, f, t) for name, row in results.items() for f, t in row["figures"].items()]
    with styled():
        figure = new_figure(9.0, 0.38 * len(names) + 1.4, "free runs from unseen starts")
        axes = figure.add_subplot()
        for y, (name, f, target) in enumerate(reversed(names)):
            values = [x[f] for x in results[name]["seeds"]]
            axes.plot(values, [y] * len(values), "o", color="C0", alpha=0.7)
            axes.plot([target] * 2, [y - 0.35, y + 0.35], color="C3")
        axes.set_yticks(range(len(names)), [f"{name}: {f}" for name, f, _ in reversed(names)])
        axes.set_xscale("log")
        axes.set_xlabel("error, one point a seed; red: target")
        save_figure(figure, path)


def main() -> None:
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds (default 5)")
    parser.add_argument("--only", nargs="*", default=[], help="rows whose names contain one of these words")
    arguments = parser.parse_args()
    path = RESULTS / "many_dof.json"
    stored: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {"rows": {}}
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=RESULTS).stdout
    stored = {"rows": stored["rows"], "torch": torch.__version__, "processor": platform.machine()}
    wanted = lambda name: not arguments.only or any(word in name for word in arguments.only)  # noqa: E731
    jobs: list[tuple[str, float, int, dict[str, float], Callable[[int], dict]]] = []
    for row in ROWS:
        own = lambda seed, row=row: motion(row, seed)  # noqa: E731
        jobs.append((row.name, row.h, arguments.seeds, {"rms": row.target}, own))
    jobs += [(name, 0.05, arguments.seeds, dict.fromkeys(f, t), run) for name, (run, f, t) in FALLS.items()]
    for name, h, seeds, figures, run in jobs:
        if wanted(name):
            found = [run(seed) for seed in range(seeds)]
            stored["rows"][name] = {"h": h, "figures": figures, "seeds": found, "commit": commit.strip()}
            order = [j[0] for j in jobs]
            stored["rows"] = dict(sorted(stored["rows"].items(), key=lambda item: order.index(item[0])))
            write_atomically(path, json.dumps(stored, indent=1).encode() + b"\n")
            write_atomically(RESULTS / "many_dof.md", table(stored["rows"]).encode())
            draw(stored["rows"], RESULTS / "many_dof.png")
            print(name, {f: [f"{x[f]:.1e}" for x in found] for f in figures}, flush=True)


if __name__ == "__main__":
    main()
