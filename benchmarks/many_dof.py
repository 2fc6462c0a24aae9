"""Several degrees of freedom and known structure: `python benchmarks/many_dof.py [--seeds 5] [--only WORD …]`.

Positions only, simulated to about 1e-13, float64. Each row names what the fit was told (`features`, `alike`, …);
the rest is the default of `fit`. Errors are of free runs from unseen starts, each given by its first two exact
positions; a relative RMS is over the RMS of the motion itself. A row is stored as soon as it is measured.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from herglotz.data import simulate
from herglotz.models import ContactLagrangian
from herglotz.scenes import scene
from herglotz.scenes.reference import reference_flow
from herglotz.scenes.scene import Scene
from herglotz.stepping import State, Stepper
from herglotz.theory import boundary_value
from herglotz.training import FitConfig, fit

HINGES = torch.tensor([[0.2, -0.1], [-0.1, 0.1]]).double()  # two viscous hinges 0.1, angles from the vertical


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
    """One case: data, and what the fit is told."""

    name: str
    make: Callable[[], Scene]
    h: float
    trajectories: int
    steps: int  # of each trajectory
    told: FitConfig
    test_steps: int
    relative: bool


def told(**settings: Any) -> FitConfig:
    """Train on everything; the model is judged on other trajectories."""
    return FitConfig(**{"train_fraction": 1.0, "objective": "residual", **settings})


# What a user knows of two links, of a planet and of a chain; order 4 needs no network.
LINKS: dict[str, Any] = {"features": ("pendulums",), "order": 4}
CENTRAL = told(level="linear", features=("central",), alike=True, order=4)  # distances alone
SPRINGS = told(level="linear", features=("chain",), alike=True, order=4)  # stretches alone
PLAIN = told(objective="auto")
JOINTS = told(level="forced", coupled=True, **LINKS)
ROWS = [
    Row("double pendulum, hinges, nothing told", hinged, 0.02, 20, 50, PLAIN, 50, False),
    Row("double pendulum, hinges, 20 × 50", hinged, 0.02, 20, 49, JOINTS, 50, False),
    Row("double pendulum, hinges, 100 × 100", hinged, 0.02, 100, 99, JOINTS, 50, False),
    Row("double pendulum, one rate, 20 × 50", lambda: scene("double_pendulum"), 0.02, 20, 49,
        told(level="linear", **LINKS), 50, False),
    Row("Kepler, drag, nothing told", lambda: scene("kepler"), 0.02, 20, 100, PLAIN, 200, True),
    Row("charged particle, drag, nothing told", charged, 0.02, 20, 100, PLAIN, 200, True),
    Row("Kepler, drag", lambda: scene("kepler"), 0.02, 20, 100, CENTRAL, 200, True),
    Row("Kepler, drag, larger step", lambda: scene("kepler"), 0.05, 20, 100, CENTRAL, 200, True),
    Row("Kepler, drag, larger step, 4 model steps", lambda: scene("kepler"), 0.05, 5, 60,
        replace(CENTRAL, objective="trajectory", substeps=4), 200, True),
    Row("chain of 10, nothing told", lambda: scene("chain", masses=10), 0.1, 10, 40, PLAIN, 200, True),
    Row("chain of 10", lambda: scene("chain", masses=10), 0.1, 10, 40, SPRINGS, 200, True),
    Row("chain of 10, larger step", lambda: scene("chain", masses=10), 0.2, 10, 40, SPRINGS, 200, True),
    Row("chain of 10, larger step, 2 model steps", lambda: scene("chain", masses=10), 0.2, 4, 30,
        replace(SPRINGS, objective="trajectory", substeps=2), 200, True),
    Row("chain of 32", lambda: scene("chain", masses=32), 0.1, 2, 20, SPRINGS, 20, True),
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


def motion(row: Row, seed: int) -> dict[str, float]:
    """One fit of one row, with its processor time and the numbers of its model."""
    of = row.make()
    data = simulate(of, trajectories=row.trajectories, steps=row.steps, h=row.h, seed=seed)
    began = time.process_time()
    run = fit(data, replace(row.told, seed=seed), progress=False)
    cost = {"cpu_s": time.process_time() - began, "parameters": run.metrics["parameters"]}
    rms, median = free_run(run.model, row, of, seed)
    return {"rms": rms, "median": median, "one_step": run.metrics["one_step_rms"], **cost}


TARGET = 1e-4  # of the RMS of a motion, relative where its row says so
JOBS = {row.name: partial(motion, row) for row in ROWS}


def table(stored: dict[str, Any]) -> str:
    """One line a row: median of the RMS, range over the seeds, target."""
    head = ("case", "h", "RMS error", "min … max", "seeds", "parameters", "fit, CPU s", "target", "met", "commit")
    steps, rows = {row.name: row.h for row in ROWS}, []
    for name, row in stored.items():
        values, cpu = ([x[key] for x in row["seeds"]] for key in ("rms", "cpu_s"))
        middle, span = statistics.median(values), f"{min(values):.1e} … {max(values):.1e}"
        met = "yes" if middle <= TARGET else "**no**"
        rows.append([name, steps[name], f"{middle:.1e}", span, len(values), row["seeds"][0]["parameters"],
                     f"{statistics.median(cpu):.0f}", f"{TARGET:g}", met, row["commit"]])  # fmt: skip
    return "\n".join(harness.table(head, rows))


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds (default 5)")
    parser.add_argument("--only", nargs="*", default=[""], help="rows whose names contain one of these words")
    arguments = parser.parse_args(argv)
    names = [name for name in JOBS if any(word in name for word in arguments.only)]
    harness.by_seed(harness.json_file(arguments, "many_dof"), JOBS, names, arguments.seeds, table)


if __name__ == "__main__":
    main()
