"""Noise, outliers, motors, bands and measured data, seed by seed: `python benchmarks/measured.py [--seeds 5]`.

Writes results/measured.json, .md and .png, and coverage.png. Settings are the defaults unless a set says otherwise
(measured_free.py, measured_windows.py, measured_coverage.py say what each is). Sets that are absent are skipped
(`--data FOLDER` says where they are). Rows that were run before are kept, each with its commit, so that parts can be
run alone. Seconds of one core for each seed: noise 13, one_trajectory 5, outliers 25, disturbed 25, real_pendulum 20,
air_track 18, driven_pendulum 110, coverage_simulated 27, coverage_real about 90; `cpu_seconds` in the table says what
it took.
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
from pathlib import Path
from typing import Any

import measured_coverage
import torch
from measured_free import AIR_TRACK, PENDULUM, disturbed, extrapolation, noise, one_trajectory, outliers
from measured_windows import DFKI, driven_pendulum

from herglotz.data.files import write_atomically

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
COVERED = (measured_coverage.LOW, measured_coverage.HIGH)
TARGETS: dict[tuple[str, str], tuple[float, float]] = {  # lowest and highest value that meets it
    ("noise", "rms_100_steps"): (0.0, 0.01),
    ("outliers", "over_clean"): (0.0, 2.0),
    ("real_pendulum", "extrapolation_rms"): (0.0, 0.013),
    ("air_track", "extrapolation_rms"): (0.0, 0.50),
    ("driven_pendulum", "over_authors_1.0s"): (0.0, 1.0),
    ("driven_pendulum", "over_authors_2.0s"): (0.0, 1.0),
    ("coverage_simulated", "laplace_measured"): COVERED,
    ("coverage_simulated", "ensemble_measured"): COVERED,
    ("coverage_real", "laplace_measured"): COVERED,
    ("coverage_real", "ensemble_measured"): COVERED,
}
ROWS: dict[str, tuple[tuple[str, ...], Callable[[int, Path], dict[str, Any]]]] = {
    "noise": ((), noise),
    "one_trajectory": ((), one_trajectory),
    "outliers": ((), outliers),
    "disturbed": ((), disturbed),
    "real_pendulum": ((PENDULUM,), extrapolation(PENDULUM)),
    "air_track": ((AIR_TRACK,), extrapolation(AIR_TRACK)),
    "driven_pendulum": (DFKI, driven_pendulum),
    "coverage_simulated": ((), measured_coverage.simulated),
    "coverage_real": ((measured_coverage.REAL,), measured_coverage.real),
}


def table(result: dict[str, Any]) -> str:
    """Median and spread of every figure."""
    lines = ["# Noise, outliers, motors, bands and measured data", "", f"{result['torch']}.", ""]
    lines += ["| set | commit | figure | seeds | median | min … max | target |", "|---|---|---|---|---|---|---|"]
    for name, row in result["rows"].items():
        for key, value in row["seeds"][0].items():
            if isinstance(value, (dict, list)):  # curves
                continue
            values = [seed[key] for seed in row["seeds"] if seed[key] is not None]
            if not values:
                continue
            low, high = TARGETS.get((name, key), (0.0, 0.0))
            target = "" if not high else f"{low:g} … {high:g}" if low else f"≤ {high:g}"
            spread = f"{min(values):.4g} … {max(values):.4g}"
            median = f"{statistics.median(values):.4g}"
            lines.append(f"| {name} | {row['commit']} | {key} | {len(values)} | {median} | {spread} | {target} |")
    return "\n".join(lines) + "\n"


def draw(result: dict[str, Any], path: Path) -> None:
    """Every error that has a target, relative to it, seed by seed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    names = [(name, key) for (name, key), (low, _) in TARGETS.items() if name in result["rows"] and not low]
    figure, ax = plt.subplots(figsize=(6, 2.6), layout="constrained")
    for i, (name, key) in enumerate(names):
        values = [seed[key] / TARGETS[name, key][1] for seed in result["rows"][name]["seeds"] if seed[key] is not None]
        ax.plot(values, [i] * len(values), "o", alpha=0.6, color="C0")
    ax.axvline(1.0, color="0.4", linewidth=1)
    ax.set(xscale="log", xlabel="figure over its target (each dot a seed)", yticks=range(len(names)))
    ax.set_yticklabels([f"{name}, {key}" for name, key in names])
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
            shown = {key: value for key, value in seeds[-1].items() if not isinstance(value, dict)}
            print(name, seed, json.dumps(shown), flush=True)
        result["rows"][name] = {"commit": commit.strip(), "seeds": seeds}
        result["rows"] = {key: result["rows"][key] for key in ROWS if key in result["rows"]}
        write_atomically(arguments.out, (json.dumps(result, indent=1) + "\n").encode())
        write_atomically(arguments.out.with_suffix(".md"), table(result).encode())
        draw(result, arguments.out.with_suffix(".png"))
        if "coverage_simulated" in result["rows"]:
            measured_coverage.draw(result["rows"], arguments.out.with_name("coverage.png"))


if __name__ == "__main__":
    main()
