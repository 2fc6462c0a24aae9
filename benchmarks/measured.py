"""Noise, outliers, motors and measured data, seed by seed: `python benchmarks/measured.py [--seeds 5] [--only NAMES]`.

Writes results/measured.json, .md and .png. Settings are the defaults unless a row says otherwise. Sets that are absent
are skipped (`--data FOLDER` says where they are). Rows that were run before are kept, so that parts can be run alone.

* noise: the simulated damped pendulum, 40 × 41 positions, h = 0.2, noise 0.01 rad (1 % of 1 rad); RMS over 100-step
  rollouts from 20 exact unseen starts against the noiseless truth. `one_trajectory`: the same from one of 41 samples.
* outliers: 6 × 61 of these positions with 2 % of them off by 0.5 … 1.5 rad, beside the same fit without outliers, and
  with outliers but without the robust loss; 60-step rollouts.
* real_pendulum, air_track: first two thirds → free run over the last third.
* double_pendulum: two of three runs train (first seconds, every 4th frame), the third tests: RMS of both angles after
  0.1, 0.25 and 0.5 s over 120 windows.
* driven_pendulum: two runs of the DFKI motor train, the third tests: free runs over 120 windows with the measured
  torque, from the same start states as the authors' identified model.
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
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories, load, simulate
from herglotz.data.files import write_atomically
from herglotz.models import ContactLagrangian
from herglotz.models.features import harmonics
from herglotz.stepping import Stepper
from herglotz.systems import scene
from herglotz.training import FitConfig, fit

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PENDULUM = "schmidt_lipson_2009/real_pend_h_1.txt"
AIR_TRACK = "schmidt_lipson_2009/real_linear_h_1.txt"
DOUBLE = tuple(f"ibm_double_pendulum/{i}.csv" for i in (2, 3, 4))
DFKI = tuple(
    f"dfki_pendulum/control_method_{name}__data_measured.csv"
    for name in ("energy_shaping", "pd__system_identification", "sac")
)
# The authors' identification: tau = J q'' + mgl sin q + b q' + c atan(100 q') + offset.
J, MGL, VISCOUS, COULOMB, OFFSET = 6.259e-2, 1.022e-1 * 9.81, 4.707e-2, 1.839e-1, -7.586e-2
TARGETS = {
    "noise": ("rms_100_steps", 0.01),
    "real_pendulum": ("extrapolation_rms", 0.013),
    "air_track": ("extrapolation_rms", 0.50),
    "outliers": ("over_clean", 2.0),
    "driven_pendulum": ("over_authors_1.0s", 1.0),
}


def rollout_rms(model: ContactLagrangian, steps: int, seed: int) -> float:
    """RMS over free runs from 20 unseen exact starts of the damped pendulum, h = 0.2."""
    test = simulate(scene("damped_pendulum"), trajectories=20, steps=steps, h=0.2, seed=seed + 500, keep_state=True)
    assert test.p is not None
    q, p = (x.reshape(20, steps + 1, 1) for x in (test.q, test.p))
    with torch.no_grad():
        out = Stepper(model).rollout(q[:, 0], p[:, 0], h=0.2, steps=steps)
    return float((out.q - q).square().mean().sqrt())


def noise(seed: int, folder: Path) -> dict[str, float]:  # noqa: ARG001  one signature for all
    data = simulate(scene("damped_pendulum"), trajectories=40, steps=40, h=0.2, noise=0.01, seed=seed)
    run = fit(data, FitConfig(train_fraction=1.0, seed=seed), progress=False)
    return {"rms_100_steps": rollout_rms(run.model, 100, seed), "train_rms": run.metrics["train_rms"]}


def one_trajectory(seed: int, folder: Path) -> dict[str, float]:  # noqa: ARG001
    data = simulate(scene("damped_pendulum"), trajectories=1, steps=40, h=0.2, noise=0.01, seed=seed)
    run = fit(data, FitConfig(train_fraction=1.0, seed=seed), progress=False)
    reach = float(data.q.abs().max())
    test = simulate(
        scene("damped_pendulum"), trajectories=20, steps=100, h=0.2, seed=seed + 500, keep_state=True,
        q_range=(-0.7 * reach, 0.7 * reach), v_range=(-0.3 * reach, 0.3 * reach),
    )  # fmt: skip
    assert test.p is not None
    q, p = (x.reshape(20, 101, 1) for x in (test.q, test.p))
    with torch.no_grad():
        out = Stepper(run.model).rollout(q[:, 0], p[:, 0], h=0.2, steps=100)
    return {"rms_100_steps": float((out.q - q).square().mean().sqrt()), "train_rms": run.metrics["train_rms"]}


def outliers(seed: int, folder: Path) -> dict[str, float]:  # noqa: ARG001
    clean = simulate(scene("damped_pendulum"), trajectories=6, steps=60, h=0.2, noise=0.01, seed=seed)
    make = torch.Generator().manual_seed(seed + 100)
    bad = torch.rand(clean.samples, generator=make) < 0.02
    size = 0.5 + torch.rand(clean.samples, generator=make, dtype=clean.q.dtype)
    sign = torch.where(torch.rand(clean.samples, generator=make) < 0.5, -1.0, 1.0)
    dirty = replace(clean, q=clean.q + (bad * sign * size)[:, None])
    found = {}
    for name, data, robust in (("clean", clean, "auto"), ("robust", dirty, "auto"), ("plain", dirty, "off")):
        run = fit(data, FitConfig(train_fraction=1.0, seed=seed, robust=robust), progress=False)
        found[name] = rollout_rms(run.model, 60, seed)
    return {**found, "over_clean": found["robust"] / found["clean"]}


def extrapolation(name: str) -> Callable[[int, Path], dict[str, float]]:
    def measure(seed: int, folder: Path) -> dict[str, float]:
        metrics = fit(load(folder / name), FitConfig(seed=seed), progress=False).metrics
        return {k: metrics[k] for k in ("extrapolation_rms", "train_rms", "rate")}

    return measure


def starts(data: Trajectories, rows: Tensor, beside: int = 8) -> tuple[Tensor, Tensor]:
    """Positions and velocities at samples, (W, n) each, by cubics through their neighbours: the same for all models."""
    near = rows[:, None] + torch.arange(-beside, beside + 1)
    x = data.t[near] - data.t[rows][:, None]
    c = torch.linalg.lstsq(torch.stack([x**k for k in range(4)], -1), data.q[near]).solution
    return c[:, 0], c[:, 1]


def momenta(model: ContactLagrangian, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
    """Momenta p = ∂L/∂v at (q, v), from D2 of a very short step that ends at q."""
    h = torch.full_like(s, 1e-4)
    return model.partials(q - 1e-4 * v, q, s, h).D2


def window_rows(data: Trajectories, steps: int, count: int = 120) -> Tensor:
    return torch.linspace(10, data.samples - steps - 11, count).round().long()


def double_pendulum(seed: int, folder: Path) -> dict[str, float]:
    runs = [load(folder / name).thinned(4) for name in DOUBLE]
    test = runs.pop(seed % 3)
    train = Trajectories.cat([replace(_first(run, 600), source=run.source) for run in runs])
    config = FitConfig(train_fraction=1.0, seed=seed, features=tuple(harmonics(train.angles)), level="linear")
    run = fit(train, config, progress=False)
    rows = window_rows(test, 50)
    q, v = starts(test, rows)
    s = torch.zeros_like(q[:, 0])
    with torch.no_grad():
        out = run.stepper.rollout(q, momenta(run.model, q, v, s), s, h=test.typical_step, steps=50)
    error = out.q - test.q[rows[:, None] + torch.arange(51)]
    return {
        **{f"rms_{t}s": float(error[:, round(100 * t)].square().mean().sqrt()) for t in (0.1, 0.25, 0.5)},
        "train_rms": run.metrics["train_rms"],
    }


def _first(data: Trajectories, count: int) -> Trajectories:
    return replace(data, t=data.t[:count], q=data.q[:count], lengths=(count,))


def driven_pendulum(seed: int, folder: Path) -> dict[str, float]:
    every = (4, 6, 4)  # 20 ms, as far as a step is 5 or 3.3 ms
    runs = [load(folder / name).with_angles("position").thinned(m) for name, m in zip(DFKI, every, strict=True)]
    *train, test = runs
    run = fit(Trajectories.cat(train), FitConfig(train_fraction=1.0, seed=seed), progress=False)
    found: dict[str, float] = {"segment_steps": run.metrics["segment_steps"]}
    assert test.u is not None
    for seconds in (0.5, 1.0, 2.0):
        steps = round(seconds / test.typical_step)
        rows = window_rows(test, steps)
        q, v = starts(test, rows)
        at = rows[:, None] + torch.arange(steps + 1)
        h, u, truth = test.t[at].diff(dim=1), test.u[at[:, :-1]], test.q[at][..., 0]
        s = torch.zeros_like(q[:, 0])
        with torch.no_grad():
            ours = run.stepper.rollout(q, momenta(run.model, q, v, s), s, h=h, inputs=u).q[..., 0]
        for name, x in (("ours", ours), ("authors", authors(q[:, 0], v[:, 0], h, u[..., 0]))):
            error = x - truth
            found[f"{name}_rms_{seconds}s"] = float(error.square().mean().sqrt())
            found[f"{name}_median_{seconds}s"] = float(error.square().mean(1).sqrt().median())
        found[f"over_authors_{seconds}s"] = found[f"ours_rms_{seconds}s"] / found[f"authors_rms_{seconds}s"]
    return found


def authors(q: Tensor, v: Tensor, h: Tensor, u: Tensor, parts: int = 4) -> Tensor:
    """Free runs of the authors' model by the midpoint rule, (W, K + 1)."""

    def acceleration(q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return (u - MGL * q.sin() - VISCOUS * v - COULOMB * (100 * v).atan() - OFFSET) / J

    out = [q]
    for k in range(h.shape[1]):
        for _ in range(parts):
            d = h[:, k] / parts
            middle = v + d / 2 * acceleration(q, v, u[:, k])
            v = v + d * acceleration(q + d / 2 * v, middle, u[:, k])
            q = q + d * middle
        out.append(q)
    return torch.stack(out, 1)


ROWS: dict[str, tuple[tuple[str, ...], Callable[[int, Path], dict[str, float]]]] = {
    "noise": ((), noise),
    "one_trajectory": ((), one_trajectory),
    "outliers": ((), outliers),
    "real_pendulum": ((PENDULUM,), extrapolation(PENDULUM)),
    "air_track": ((AIR_TRACK,), extrapolation(AIR_TRACK)),
    "double_pendulum": (DOUBLE, double_pendulum),
    "driven_pendulum": (DFKI, driven_pendulum),
}


def table(result: dict[str, Any]) -> str:
    lines = ["# Noise, outliers, motors and measured data", "", f"Commit {result['commit']}; {result['torch']}.", ""]
    lines += ["| set | figure | seeds | median | min … max | target |", "|---|---|---|---|---|---|"]
    for name, row in result["rows"].items():
        for key in row["seeds"][0]:
            values = [seed[key] for seed in row["seeds"] if seed[key] is not None]
            if not values or key == "cpu_seconds":
                continue
            aim = TARGETS.get(name, ("", 0.0))
            target = f"≤ {aim[1]:g}" if aim[0] == key else ""
            spread = f"{min(values):.4g} … {max(values):.4g}"
            lines.append(f"| {name} | {key} | {len(values)} | {statistics.median(values):.4g} | {spread} | {target} |")
    return "\n".join(lines) + "\n"


def draw(result: dict[str, Any], path: Path) -> None:
    """Every figure that has a target, relative to it, seed by seed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    names = [name for name in result["rows"] if name in TARGETS]
    figure, ax = plt.subplots(figsize=(6, 2.6), layout="constrained")
    for i, name in enumerate(names):
        key, target = TARGETS[name]
        values = [seed[key] / target for seed in result["rows"][name]["seeds"]]
        ax.plot(values, [i] * len(values), "o", alpha=0.6, color="C0")
    ax.axvline(1.0, color="0.4", linewidth=1)
    ax.set(xscale="log", xlabel="figure over its target (each dot a seed)", yticks=range(len(names)))
    ax.set_yticklabels(names)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))  # small matrices: more threads only wait
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds (default 5)")
    parser.add_argument("--only", default=",".join(ROWS), help=f"some of {', '.join(ROWS)}")
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of measured sets")
    parser.add_argument("--out", type=Path, default=RESULTS / "measured.json")
    arguments = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT).stdout
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "threads": torch.get_num_threads()}
    old = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"rows": {}}
    result: dict[str, Any] = {"commit": commit.strip(), "machine": machine, "torch": torch.__version__}
    result["rows"] = old["rows"]
    for name in arguments.only.split(","):
        files, measure = ROWS[name]
        if not all((arguments.data / file).exists() for file in files):
            print(f"{name}: skipped, no {files[0]} in {arguments.data}")
            continue
        seeds = []
        for seed in range(arguments.seeds):
            began = time.process_time()
            seeds.append({**measure(seed, arguments.data), "cpu_seconds": round(time.process_time() - began, 1)})
            print(name, seed, json.dumps(seeds[-1]), flush=True)
        result["rows"][name] = {"commit": commit.strip(), "seeds": seeds}
        result["rows"] = {key: result["rows"][key] for key in ROWS if key in result["rows"]}
        write_atomically(arguments.out, (json.dumps(result, indent=1) + "\n").encode())
        write_atomically(arguments.out.with_suffix(".md"), table(result).encode())
        draw(result, arguments.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
