"""Much at once: a large batch, a long csv, many recordings or coordinates: `python -m benchmarks.load`.

Processor time and memory.

Every row runs in a process of its own, with one thread. Memory is the most that it held beyond what it held before the
work: with the package imported and, for the batch, the stepper and the state made.
"""

from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import herglotz as hz
from benchmarks import harness
from benchmarks.stepper import model_of, rolls, start
from herglotz.export import compile_c

BATCH, STEPS = 65_536, 20  # of issue 16
ROWS, MANY = 1_000_000, 1000  # samples of the csv; recordings of 100 samples each
MASSES, SAMPLES, NOISE = 20, 200, 0.01  # of the chain that is fitted; noise in standard deviations of the motion
COLUMNS = ("t[s],theta[rad],x[m]", "trajectory,t[s],theta[rad],x[m]")


def csv(path: Path, recordings: int, samples: int) -> Callable[[], Any]:
    """Load two coordinates of this many recordings, from a file that another process writes: its memory is not ours."""
    writer = multiprocessing.get_context("fork").Process(target=write, args=(path, recordings, samples))
    writer.start()
    writer.join()
    return lambda: hz.load(path)


def write(path: Path, recordings: int, samples: int) -> None:
    """A file of two coordinates, by numpy."""
    t = np.tile(0.01 * np.arange(samples), recordings)
    values = [t, np.sin(t), np.cos(2 * t)]
    if recordings > 1:
        values.insert(0, np.repeat(np.arange(recordings), samples))
    np.savetxt(path, np.stack(values, 1), "%.9g", ",", header=COLUMNS[recordings > 1], comments="")


def chain(noise: float = 0.0) -> Callable[[], Any]:
    """Fit the motion of a chain of masses between two walls, a sum of damped normal modes."""
    make, t = np.random.default_rng(0), 0.1 * np.arange(SAMPLES)[:, None]
    stiffness = 2 * np.eye(MASSES) - np.eye(MASSES, k=1) - np.eye(MASSES, k=-1)
    squares, modes = np.linalg.eigh(stiffness)
    a, b, turned = make.standard_normal(MASSES), make.standard_normal(MASSES), t * squares**0.5
    q = np.exp(-0.025 * t) * (a * np.cos(turned) + b * np.sin(turned)) @ modes.T
    q = q + noise * q.std() * make.standard_normal(q.shape)
    return lambda: hz.fit([q], h=0.1, progress=False)


def batch(make: Callable[[Any], Any]) -> Callable[[], Any]:
    """Roll a batch of two coordinates out."""
    model = model_of(2)
    return rolls(make(model), start(2, BATCH, torch.float64), STEPS)


# Rows of the table.
WORK: dict[str, tuple[Callable[[Path], Callable[[], Any]], str]] = {
    f"csv, {ROWS} rows": (lambda path: csv(path, 1, ROWS), "≤ 3 s, ≤ 200 MB"),
    f"csv, {MANY} trajectories of 100 rows": (lambda path: csv(path, MANY, 100), ""),
    f"fit, {MASSES} coordinates, {SAMPLES} samples": (lambda _: chain(), "≤ 60 s"),
    f"fit, {MASSES} coordinates, {SAMPLES} samples, noise of {NOISE:.0%}": (lambda _: chain(NOISE), "≤ 60 s"),
    f"C, B = {BATCH}, {STEPS} steps": (lambda _: batch(lambda model: compile_c(model, h=0.1)), ""),
    f"eager, B = {BATCH}, {STEPS} steps": (lambda _: batch(hz.Stepper), ""),
}


def measured(name: str) -> dict[str, float]:
    """Seconds and MB of one row, in this process."""
    status = Path("/proc/self/status")
    with tempfile.TemporaryDirectory() as folder:
        run = WORK[name][0](Path(folder) / "long.csv")
        Path("/proc/self/clear_refs").write_text("5")  # Linux: the peak begins anew
        before, took, after = status.read_text(), harness.seconds(run), status.read_text()
    peaks = [int(x.split("VmHWM:")[1].split()[0]) / 1000 for x in (before, after)]  # of kB
    return {"seconds": took, "MB": peaks[1] - peaks[0]}


def main() -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--one", choices=WORK, help="measure this row here, and print it as JSON")
    arguments = parser.parse_args()
    if arguments.one:
        return print(json.dumps(measured(arguments.one)))
    path, rows = harness.json_file(arguments, "load"), {}
    for name in WORK:
        words = [sys.executable, "-m", "benchmarks.load", "--one", name]
        said = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, cwd=harness.ROOT).stdout
        rows[name] = json.loads(said.splitlines()[-1])
        print(name, rows[name], flush=True)
        lines = [(k, f"{v['seconds']:.2g}", f"{v['MB']:.0f}", WORK[k][1]) for k, v in rows.items()]
        text = "\n".join(harness.table(("what", "s", "MB", "target"), lines))
        harness.store(path, {**harness.conditions(), "rows": rows}, f"# Load\n\n{__doc__}\n{text}")


if __name__ == "__main__":
    main()
