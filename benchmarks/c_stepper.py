"""Time a step of the compiled C header against the eager stepper: `python benchmarks/c_stepper.py [--out FILE.json]`.

One sample, one thread. The two are timed in turn within each repeat, so that a busy machine slows both; the ratios are
of one repeat, and the table gives their median and range.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import time
from pathlib import Path

import torch

from herglotz.export import compile_c
from herglotz.export.c_wrapper import FLAGS, compiler
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.stepping import Stepper

H = 0.1
CASES = [(n, width) for width in (0, 16) for n in (1, 2)]


def model_of(n: int, width: int) -> ContactLagrangian:
    """A lightly damped pendulum (or two) with random networks, so that no step is trivial."""
    one = (1.0,) * n
    model = ContactLagrangian(
        ModelConfig((True,) * n, "linear", one, one, one, (0.0,) * n, correction_width=width, correction_depth=2)
    )
    make = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.05 * torch.randn(parameter.shape, generator=make, dtype=torch.float64)
    return model


def measure(n: int, width: int, dtype: str, repeats: int) -> dict:
    model = model_of(n, width).to(getattr(torch, dtype))
    compiled, eager = compile_c(model, h=H), Stepper(model)
    q = torch.full((n,), 0.5, dtype=compiled.dtype)
    p = torch.zeros_like(q)
    ours, theirs = [], []
    with torch.no_grad():
        for _ in range(repeats + 1):  # the first one warms up
            ours.append(_seconds(lambda: compiled.rollout(q, p, h=H, steps=5000)) / 5000)
            theirs.append(_seconds(lambda: eager.rollout(q, p, h=H, steps=50)) / 50)
    ours, theirs = ours[1:], theirs[1:]
    ratios = [b / a for a, b in zip(ours, theirs, strict=True)]
    micro = [1e6 * x for x in (statistics.median(ours), statistics.median(theirs))]
    spread = {"median": statistics.median(ratios), "min": min(ratios), "max": max(ratios)}
    return {"n": n, "correction": width, "dtype": dtype, "c_us": micro[0], "eager_us": micro[1], "ratio": spread}


def _seconds(run) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def main() -> None:
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=7, help="timings of each case (default 7)")
    parser.add_argument("--out", type=Path, help="write JSON here, e.g. benchmarks/results/c_stepper.json")
    arguments = parser.parse_args()
    rows = []
    print(f"{'model':<28}{'C, µs/step':>12}{'eager, µs':>12}{'eager / C':>12}   range")
    for dtype in ("float64", "float32"):
        for n, width in CASES:
            row = measure(n, width, dtype, arguments.repeats)
            rows.append(row)
            name = f"n={n} {'correction 16x2' if width else 'linear'} {dtype}"
            r = row["ratio"]
            numbers = f"{row['c_us']:>12.2f}{row['eager_us']:>12.0f}{r['median']:>12.0f}"
            print(f"{name:<28}{numbers}   {r['min']:.0f} to {r['max']:.0f}")
    if arguments.out:
        command = compiler()
        version = subprocess.run([*command, "--version"], capture_output=True, text=True, check=False).stdout
        result = {
            "machine": {"processor": _processor(), "cores": os.cpu_count(), "load": os.getloadavg(), "threads": 1},
            "versions": {"torch": torch.__version__, "python": platform.python_version()},
            "compiler": {"version": version.splitlines()[0] if version else command[0], "flags": FLAGS},
            "h": H,
            "rows": rows,
        }
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(result, indent=1) + "\n")


def _processor() -> str:
    """The name of the processor, where the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    return next((x.split(":", 1)[1].strip() for x in lines if x.startswith("model name")), platform.machine())


if __name__ == "__main__":
    main()
