"""The headline figures, seed by seed: `python benchmarks/learned.py [--seeds 5] [--out FILE.json]`.

* measured: extrapolation RMS on the measured pendulum of Schmidt & Lipson (2009), default settings;
* simulated: exact damped pendulum, 40 × 41 positions, h = 0.5; RMS over 100 steps from 5 sets of 20 unseen starts.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
from pathlib import Path

import torch

from herglotz.data import load, simulate
from herglotz.stepping import Stepper
from herglotz.systems import scene
from herglotz.training import FitConfig, fit

ROOT = Path(__file__).resolve().parents[1]
MEASURED = ROOT.parent / "shared" / "data" / "schmidt_lipson_2009" / "real_pend_h_1.txt"
H = 0.5


def measured(seed: int, level: str = "linear") -> dict:
    metrics = fit(load(MEASURED), FitConfig(seed=seed, level=level), progress=False).metrics
    return {k: metrics[k] for k in ("extrapolation_rms", "train_rms", "rate", "departure", "held_out_rms", "seconds")}


def simulated(seed: int) -> dict:
    pendulum = scene("damped_pendulum")
    data = simulate(pendulum, trajectories=40, steps=40, h=H, seed=seed)
    run = fit(data, FitConfig(train_fraction=1.0, seed=seed), progress=False)
    rms, median = [], []
    for test in range(1000, 1005):
        q = simulate(pendulum, trajectories=20, steps=101, h=H, seed=test).q.reshape(20, 102, 1)
        stepper = Stepper(run.model)
        with torch.no_grad():
            out = stepper.rollout(*stepper.init(q[:, 0], q[:, 1], None, H), h=H, steps=100)
        error = out.q - q[:, 1:]
        rms.append(error.square().mean().sqrt().item())
        median.append(error.abs().median().item())
    return {"rms": rms, "median": median, "one_step": run.metrics["one_step_rms"], "seconds": run.metrics["seconds"]}


def main() -> None:
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))  # small matrices: more threads only wait
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5, help="how many seeds (default 5)")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "learned.json")
    arguments = parser.parse_args()
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT).stdout
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "threads": torch.get_num_threads()}
    result: dict = {"commit": commit.strip(), "machine": machine, "torch": torch.__version__}
    if MEASURED.exists():
        result["measured"] = [measured(seed) for seed in range(arguments.seeds)]
        values = [r["extrapolation_rms"] for r in result["measured"]]
        print(f"measured, linear: {statistics.median(values):.4f} rad median, {min(values):.4f}–{max(values):.4f}")
    else:
        print("measured: skipped, the file is not here (data/README.md says where to get it)")
    result["simulated"] = [simulated(seed) for seed in range(arguments.seeds)]
    values = [x for r in result["simulated"] for x in r["rms"]]
    first = [r["rms"][0] for r in result["simulated"]]
    print(f"simulated: RMS {statistics.median(values):.1e} rad median of all, {min(values):.1e}–{max(values):.1e}")
    print(f"           first test set {statistics.median(first):.1e}, {min(first):.1e}–{max(first):.1e}")
    print(f"           training {[round(r['seconds']) for r in result['simulated']]} s")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
