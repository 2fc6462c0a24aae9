"""`rti.c` of `examples/real_time_iteration` in closed loop, for `benchmarks/control.py`.

The true plant of `examples/mpc_swing_up.py` from random starts; its positions are read with the noise of the
recordings, and a Kalman filter on the learned step makes states of them. Before the first sample the controller
iterates until its plan keeps the bounds; then there is one iteration a sample.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks import harness
from benchmarks.control_model import H, model
from herglotz.export import compile_c
from herglotz.stepping import State
from herglotz.stepping.filter import Belief, KalmanFilter, Noise

N, STEPS = 50, 8  # intervals, and steps in one
INTERVAL = STEPS * H  # s
UPRIGHT, WEIGHT = np.array([0.0, np.pi, 0.0, 0.0, 0.0]), np.array([1.0, 2.0, 0.05, 0.5, 0.0])
FORCE, FORCE_WEIGHT, LAST = 12.0, 0.003, 20.0
TRACK, BARRIER = 0.9, 10.0  # m to either side; the barrier's weight
MISS = 1e-3  # m: what the model misses in an interval
SENSOR = 1e-3  # m and rad: the noise of positions, as in the recordings of the example
NOISE = Noise((1.04e-3, 1.06e-3), (4.5e-4, 1.0e-4), adaptation=0.02)  # of `noise_of` for its fit
START = (SENSOR, SENSOR, 0.5, 0.15)  # deviations of x, θ and their momenta over the starts
Plant = Callable[..., np.ndarray]


class Controller(ctypes.Structure):
    """`rti` of rti.c."""

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
