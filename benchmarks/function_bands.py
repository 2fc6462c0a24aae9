"""Bands of learned functions on laws that no dictionary holds: `python benchmarks/function_bands.py [--seeds 5]`.

Each law is drawn once a seed, recorded in three motions of 300 samples with noise of 0.5 % of their spread, and fitted
by default. Of every function of `learned_functions` it is measured at 101 points inside the data how many the 90 % band
holds of the truth, and the RMS errors of the model and of the posterior's mean over the largest value. A function is
one draw: its points hang together, so that the share of one function says little, and their mean over all much more.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.random import Generator

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.zoo_systems.mechanisms import Array
from benchmarks.zoo_systems.open_systems import OpenMechanism, linkage, motion, single, wire
from herglotz.data import Trajectories
from herglotz.training import LearnedFunction, Run, fit, laplace, learned_functions

MOTIONS, SAMPLES, STEP, NOISE = 3, 300, 0.08, 0.005
LEVEL = 0.9  # share of the truth that bands are to hold
FUNCTIONS = ("potential", "force", "friction", "damping", "mass")
KINDS = ("well", "quartic", "saturating", "ring", "wire")


@dataclass(frozen=True)
class Law:
    """M(q) q̈ = −½ M′ q̇² − V′(q) − f(q, q̇), of one coordinate."""

    mechanism: OpenMechanism
    slope: Callable[[Array], Array]  # V′
    friction: Callable[[Array, Array], Array]  # f
    mass: Callable[[Array], Array]  # M


def law(kind: str, rng: Generator) -> Law:
    """A law of one of `KINDS`: log-cosh or quartic wells and rings with a bump, and a bead on a wire with one."""
    hard, steep, d, e = (rng.uniform(*x) for x in ((1.0, 2.0), (2.0, 3.5), (0.03, 0.08), (0.1, 0.3)))
    A, c, w, kappa = (rng.uniform(*x) for x in ((0.2, 0.6), (-0.5, 0.5), (0.2, 0.4), (3.0, 10.0)))
    A, place, width = A * rng.choice([-1, 1]), rng.uniform(-0.3, 0.3), rng.uniform(0.3, 0.6)
    bump = lambda q: -A * (q - c) / w * np.exp(-(((q - c) / w) ** 2) / 2)  # noqa: E731
    viscous = lambda q, v: d * v  # noqa: ARG005, E731
    around = lambda q, v: (d + e * np.exp(-(((q - place) / width) ** 2))) * v  # noqa: E731
    limited = lambda q, v: d * v + 0.3 * e * np.tanh(v / (0.5 * width))  # noqa: ARG005, E731
    if kind == "wire":
        f = wire(0.7 + 0.6 * rng.random(), 0.15 + 0.3 * rng.random(), 0.4)
        mechanism = OpenMechanism(kind, 1, (False,), linkage(f, 1.0, 1.0, 0.0, d, 0.0), {}, (1.2, 0.8))
        return Law(mechanism, lambda q: f(q)[1], viscous, lambda q: 1 + f(q)[1] ** 2)
    slope, rub, reach = {
        "well": (lambda q: hard * np.tanh(steep * q) + bump(q), around, (1.0, 0.8)),
        "quartic": (lambda q: hard * q**3 + 0.5 * q + bump(q), viscous, (1.0, 0.8)),
        "saturating": (lambda q: hard * np.tanh(steep * q), limited, (1.0, 0.8)),
        "ring": (lambda q: np.sin(q) - A * kappa * np.sin(q - c) * np.exp(kappa * (np.cos(q - c) - 1)), viscous,
                 (2.2, 1.0)),
    }[kind]  # fmt: skip
    return Law(OpenMechanism(kind, 1, (kind == "ring",), single(slope, rub, 0.0), {}, reach), slope, rub, np.ones_like)


def recorded(of: Law, rng: Generator) -> Trajectories:
    """Motions of a law with noise."""
    t, reach = STEP * np.arange(SAMPLES, dtype=np.float64), of.mechanism.reach
    signs = rng.choice([-1, 1], (MOTIONS, 2))
    x0 = np.array(reach) * signs * rng.uniform(0.4, 1.0, (MOTIONS, 2))
    truth = motion(of.mechanism, x0, t, np.zeros((MOTIONS, SAMPLES)))
    q = truth + NOISE * truth.std() * rng.standard_normal(truth.shape)
    return Trajectories.of(
        np.tile(t, MOTIONS),
        q.reshape(-1, 1),
        (SAMPLES,) * MOTIONS,
        angles=of.mechanism.angles,
        source=of.mechanism.kind,
    )


def truth(of: Law, run: Run, f: LearnedFunction) -> Array:
    """The values of a law at the points of a learned function, in the gauge of `learned_functions`."""
    x = f.x.numpy()
    rows = [torch.arange(a, a + k) for a, k in zip(run.data.offsets, run.train_lengths, strict=True)]
    q = [run.states.q[row, 0].detach().double() for row in rows]
    speed = float(torch.cat([x.diff() for x in q]).square().mean().sqrt() / STEP)
    seen = torch.cat(q)
    found: dict[str, Callable[[], Array]] = {
        "force": lambda: -of.slope(x),
        "potential": lambda: _centred(np.concatenate([[0], np.cumsum((of.slope(x)[1:] + of.slope(x)[:-1]) / 2)]), x),
        "friction": lambda: -of.friction(np.full_like(x, float(seen.median())), x),
        "damping": lambda: of.friction(x, np.full_like(x, speed)) / speed,
        "mass": lambda: of.mass(x),
    }
    return found[f.kind]() / of.mass(seen.numpy()).mean()


def _centred(sums: Array, x: Array) -> Array:
    V = sums * (x[1] - x[0])
    return V - V.mean()


def measured(kind: str, seed: int) -> dict[str, Any]:
    """Of every function that a fit has learned: what its band holds, and errors of the model and of the posterior."""
    rng = np.random.default_rng([41, KINDS.index(kind), seed])
    of = law(kind, rng)
    run = fit(recorded(of, rng), progress=False)
    fitted, functions = time.process_time(), {}
    for f in learned_functions(laplace(run)):
        assert f.mean is not None
        true, (low, high) = truth(of, run, f), (x.numpy() for x in f.interval(LEVEL))
        errors = (np.sqrt(np.mean((y.numpy() - true) ** 2)) / np.abs(true).max() for y in (f.value, f.mean))
        share = np.mean((low <= true) & (true <= high))
        functions[f.kind] = dict(zip(("inside", "error", "mean_error"), map(float, (share, *errors)), strict=True))
    bands = round(time.process_time() - fitted, 1)
    return {"verdict": run.metrics["verdict"].split(":")[0], "bands_seconds": bands, "functions": functions}


def shares(rows: dict[str, Any]) -> dict[str, list[float]]:
    """The shares of points inside, of all laws and seeds, by kind of function."""
    found: dict[str, list[float]] = {}
    for row in rows.values():
        for one in row["seeds"]:
            for kind, f in one["functions"].items():
                found.setdefault(kind, []).append(f["inside"])
    return found


def table(rows: dict[str, Any]) -> str:
    """Means over the seeds, by law and of all."""
    head = ("law", *(f"{kind}: inside, error, of the mean" for kind in FUNCTIONS), "commit")
    lines = []
    for kind, row in rows.items():
        cells = []
        for function in FUNCTIONS:
            found = [one["functions"][function] for one in row["seeds"] if function in one["functions"]]
            means = (
                statistics.mean(f[key] for f in found) if found else 0.0 for key in ("inside", "error", "mean_error")
            )
            inside, error, mean = means
            cells.append(f"{100 * inside:.0f} %, {error:.1e}, {mean:.1e} ({len(found)})" if found else "")
        lines.append((kind, *cells, row["commit"]))
    every = shares(rows)
    total = [
        f"{100 * statistics.mean(every[kind]):.0f} % ({len(every[kind])})" if kind in every else ""
        for kind in FUNCTIONS
    ]
    lines.append(
        ("all", *total, f"{100 * statistics.mean(x for own in every.values() for x in own):.1f} % of all points")
    )
    return "\n".join(["# 90 % bands of learned functions: points inside the data that hold the truth", "",
                      "RMS errors over the largest value, of the model and of the posterior's mean (functions).",
                      "", *harness.table(head, lines)])  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Measure every law with every seed."""
    parser = harness.parser(__doc__)
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds (default 5)")
    parser.add_argument("--laws", help=f"of {', '.join(KINDS)} (default all)")
    arguments = parser.parse_args(argv)
    names = harness.chosen(parser, arguments.laws, KINDS, "law")
    jobs = {kind: partial(measured, kind) for kind in KINDS}
    harness.by_seed(harness.json_file(arguments, "function_bands"), jobs, names, arguments.seeds, table)


if __name__ == "__main__":
    main()
