"""The exported step in control: `python benchmarks/control.py [--quick] [--out FOLDER]`.

A real-time iteration (`rti.c` of `examples/real_time_iteration`) in closed loop: the true plant of
`examples/mpc_swing_up.py` from random starts, whose positions are read with the noise of the recordings, and a Kalman
filter on the learned step that makes states of them. One thread. Writes control.json and control.md.
"""

from __future__ import annotations

import ctypes
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from herglotz.codegen.c_compiler import compiler
from herglotz.export import compile_c, export_casadi
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.numbers import with_values
from herglotz.stepping import State
from herglotz.stepping.filter import Belief, KalmanFilter, Noise

# The learned model. The numbers are those that the example learns of its recordings; the fit is not repeated.
H = 0.00625  # s: the model's own step
STIFFNESS, RATE = 1.12807918135, 0.00105678298
NUMBERS = {
    "kinetic.base.log_diagonal": math.log(0.23984877),
    "kinetic.base.off_diagonal": 0.00031584926745,
    "kinetic.sum.coefficient": 0.11501273180,
    "friction.viscous[0]": 0.30569501943,
    "friction.viscous[1]": 0.00761698943,
    "friction.input_map[0]": 0.76955898360,
    "friction.input_map[1]": 0.00029280290,
    "drag.coefficient": -0.00528029567,
}

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
    return with_values(ContactLagrangian(config), NUMBERS)


def controller(folder: Path) -> ctypes.CDLL:
    """The real-time iteration on the exported step, compiled."""
    export_casadi(model(), folder / "model.c", h=H, name="model")
    source, library = harness.ROOT / "examples" / "real_time_iteration" / "rti.c", folder / "rti.so"
    subprocess.run([*compiler(), *FLAGS, f"-I{folder}", str(source), "-o", str(library), "-lm"], check=True)
    return ctypes.CDLL(str(library))


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


def measured(library: ctypes.CDLL, starts: int) -> list[Row]:
    """From random starts: up for 10 s after at most 5 s, and the time of an iteration."""
    found = from_random_starts(library, starts, round(15.0 / INTERVAL))
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


def table(rows: list[Row]) -> str:
    """Markdown: a line a number."""
    cells = [(row["what"], f"{row['value']:.3g}", row.get("target", "")) for row in rows]
    return "\n".join(harness.table(("what", "measured", "target"), cells))


def main(argv: list[str] | None = None) -> None:
    """Measure, and write both files."""
    arguments = harness.parser(__doc__, quick=True).parse_args(argv)
    path = harness.json_file(arguments, "control")
    with tempfile.TemporaryDirectory(prefix="herglotz-bench-") as folder:
        rows = measured(controller(Path(folder)), 1 if arguments.quick else 100)
    harness.store(path, {**harness.conditions(), "rows": rows}, table(rows))
    print(path.with_suffix(".md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
