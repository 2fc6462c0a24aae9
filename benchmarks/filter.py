"""The Kalman filter of a C header, on a payload that changes and on a measured arm: `python benchmarks/filter.py`.

* payload: two links with motors, simulated; an encoder of 1 mrad at 100 Hz. After 10 s the second link is 30 % heavier.
  Errors of what is predicted a second ahead, 5 to 8.5 s later, over those of the filter that has the true numbers of
  the heavier arm all the time. One number, `between` the arm and one of twice the second link, wanders by 0.005 a root
  second, or each of the ten numbers that a payload changes by 0.003 of itself.
* measured: four windows of the UW double pendulum, of all energies, train; the 22 others are followed, of which the
  filters see every tenth sample (50 Hz). The velocity that they are held beside is that of polynomials of degree 5 over
  21 samples of the recording (500 Hz). The other filter assumes a constant acceleration, with the noise in its jerk
  that serves it best. NIS is that of the filter that learns the scale of its noise, and of one that does not.

`--data FOLDER` says where the measured set is; about three minutes of processor time, most of them the fit.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from herglotz import fit
from herglotz.codegen.c_compiler import build
from herglotz.data import load
from herglotz.export import export_c, noise_of
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.numbers import chosen, combined, values_of, with_values

Array = np.ndarray[Any, Any]
LOOP = """
#include "stepper.h"
#ifndef arm_P
#define arm_P 0
#endif
int follow(long count, long parts, double h, long ahead, double adaptation, const double *start, const double *std,
           const double *noises, const double *y, const double *u, double *q, double *v, double *theta,
           double *surprise, double *predicted) {
  arm_noise noise;
  arm_filter filter;
  arm_state x = arm_start;
  long k, a, j;
  int i, status;
  (void)u;
  (void)theta;
  noise.adaptation = adaptation;
  for (i = 0; i < arm_N; i++) {
    noise.position[i] = noises[i];
    noise.momentum[i] = noises[arm_N + i];
    x.q[i] = start[i];
    x.p[i] = start[arm_N + i];
  }
#if PARAMETERS
  for (i = 0; i < arm_P; i++) noise.theta[i] = noises[2 * arm_N + i];
#endif
  status = arm_filter_start(&filter, &x, THETA(0) std);
  for (k = 0; k < count; k++) {
    for (j = 0; k && j < parts; j++) status |= arm_filter_predict(&filter, h, INPUT(k - 1) &noise);
    if (k) status |= arm_filter_update(&filter, y + k * arm_N, &noise, surprise + k);
    status |= arm_filter_velocity(&filter, h, INPUT(k) v + k * arm_N, 0);
    for (i = 0; i < arm_N; i++) q[k * arm_N + i] = filter.x.q[i];
#if PARAMETERS
    for (i = 0; i < arm_P; i++) theta[k * arm_P + i] = filter.theta.value[i];
#endif
    x = filter.x;
    for (a = 0; a < ahead && k + ahead < count; a++)
      for (j = 0; j < parts; j++) status |= arm_step(&x, h, INPUT(k + a) THETA(&filter.theta) 0);
    for (i = 0; i < arm_N; i++) predicted[k * arm_N + i] = x.q[i];
  }
  return status & 15;
}
"""


class Followed:
    """What the filter of a header makes of readings y (N, n), with inputs u (N, m)."""

    def __init__(
        self, model: ContactLagrangian, h: float, parts: int, y: Array, noise: Sequence[float], std: Sequence[float],
        names: Sequence[str] = (), u: Array | None = None, ahead: int = 0, start: Array | None = None,
        adaptation: float = 0.0,
    ):  # fmt: skip
        library = header(model, h / parts, tuple(names), u is not None)
        count, n = y.shape
        sizes = {"q": n, "v": n, "theta": max(1, len(noise) - 2 * n), "surprise": 1, "predicted": n}
        found = {name: np.full((count, size), np.nan) for name, size in sizes.items()}
        begin = np.concatenate([y[0], np.zeros(n)]) if start is None else start
        rows = [np.ascontiguousarray(x, dtype=float) for x in (begin, std, noise, y, y if u is None else u)]
        numbers = ctypes.c_long(count), ctypes.c_long(parts), ctypes.c_double(h / parts), ctypes.c_long(ahead)
        numbers = (*numbers, ctypes.c_double(adaptation))
        status = library.follow(*numbers, *(ctypes.c_void_p(x.ctypes.data) for x in (*rows, *found.values())))
        assert status == 0, status
        self.q, self.v, self.theta, surprise, self.predicted = found.values()
        self.surprise = surprise[:, 0]


LIBRARIES: dict[Any, Any] = {}


def header(model: ContactLagrangian, h: float, names: tuple[str, ...], driven: bool) -> Any:
    """The compiled filter of a model."""
    key = (id(model), h, names)
    if key not in LIBRARIES:
        with tempfile.TemporaryDirectory() as folder:
            text = export_c(model, Path(folder) / "stepper.h", h=h, name="arm", parameters=names, extras=["filter"])
            loop = LOOP.replace("PARAMETERS", str(int(bool(names))))
            for word, there in (("THETA", bool(names)), ("INPUT", driven)):
                with_argument = "argument," if word == "THETA" else "u + (argument) * arm_M,"
                loop = f"#define {word}(argument) {with_argument if there else ''}\n{loop}"
            LIBRARIES[key] = model, build(text.read_text(), loop)
    return LIBRARIES[key][1]


# The simulated arm: two links of point masses, 0.3 m each; the first weighs 1 kg.
G, LENGTH, FIRST, SECOND, VISCOUS = 9.81, 0.3, 1.0, 0.8, (0.02, 0.01)
DT, CHANGE, COUNT, AHEAD, SENSOR = 0.01, 1000, 1950, 100, 1e-3
MOVED = ("kinetic.base.log_diagonal", "kinetic.sum.coefficient", "potential.stiffness", "friction.viscous",
         "friction.input_map")  # fmt: skip


def arm(second: float) -> ContactLagrangian:
    """Its model, with the first entry of the mass as the unit."""
    config = ModelConfig((True, True), "forced", (1.0, 1.0), (3.0, 3.0), (9.0, 9.0), (0.0, 0.0), rate=0.0,
                         potential_width=0, features=("cos(q1 - q2) v1 v2",), inputs=2, diagonal=True)  # fmt: skip
    whole, tip = (FIRST + second) * LENGTH**2, second * LENGTH**2
    model = ContactLagrangian(config).requires_grad_(False).double()
    numbers = (0.5 * math.log(tip / whole), tip / whole, G / LENGTH, second * G * LENGTH / whole,
               *(b / whole for b in VISCOUS), 1 / whole, -1 / whole, 0.0, 1 / whole)  # fmt: skip
    return with_values(model, dict(zip(chosen(model, MOVED), numbers, strict=True)))


def simulated(u: Array) -> Array:
    """Positions (N, 2) under held torques u (N, 2), by the classical Runge–Kutta rule; the load comes at `CHANGE`."""
    x, found = np.array([0.3, -0.2, 0.0, 0.0]), []

    def field(x: Array, u: Array, second: float) -> Array:
        (q1, q2, v1, v2), c = x, second * LENGTH**2
        mass = np.array([[(FIRST + second) * LENGTH**2, c * np.cos(q1 - q2)], [c * np.cos(q1 - q2), c]])
        turn, weight = c * np.sin(q1 - q2), G * LENGTH
        force = np.array([
            u[0] - u[1] - turn * v2 * v2 - (FIRST + second) * weight * np.sin(q1) - VISCOUS[0] * v1,
            u[1] + turn * v1 * v1 - second * weight * np.sin(q2) - VISCOUS[1] * v2,
        ])  # fmt: skip
        return np.concatenate([x[2:], np.linalg.solve(mass, force)])

    step = DT / 5
    for k, torque in enumerate(u):
        found.append(x[:2])
        second = SECOND * (1.3 if k >= CHANGE else 1.0)
        for _ in range(5):
            a = field(x, torque, second)
            b = field(x + step / 2 * a, torque, second)
            c = field(x + step / 2 * b, torque, second)
            x = x + step / 6 * (a + 2 * b + 2 * c + field(x + step * c, torque, second))
    return np.array(found)


def payload(seed: int) -> dict[str, float]:
    """Errors a second ahead, 5 to 8.5 s after the load came, over those with the true numbers."""
    make, t = np.random.default_rng(seed), DT * np.arange(COUNT)
    waves = [(a, make.uniform(0.2, 2.0), make.uniform(0, 2 * np.pi)) for a in (0.3, 0.12) for _ in range(6)]
    parts = np.array([a * np.sin(2 * np.pi * f * t + phase) for a, f, phase in waves])
    u = np.stack([parts[:6].sum(0), parts[6:].sum(0)], -1)
    q = simulated(u)
    y = q + SENSOR * make.normal(size=q.shape)
    before, after, double = arm(SECOND), arm(1.3 * SECOND), arm(2 * SECOND)
    names = chosen(before, MOVED)
    one = combined(before, "payload", dict(zip(names, values_of(double, names), strict=True)))
    each = np.maximum(np.abs(values_of(before, names)), 1.0)

    def error(model: ContactLagrangian, names: Sequence[str], wander: Sequence[float], std: Sequence[float]) -> float:
        noise, first = [SENSOR, SENSOR, 0.01, 0.01, *wander], [SENSOR, SENSOR, 0.05, 0.05, *std]
        found = Followed(model, DT, 2, y, noise, first, names, u, AHEAD)
        rows = np.arange(CHANGE + 500, CHANGE + 850)
        return float(np.sqrt(np.mean((found.predicted[rows] - q[rows + AHEAD]) ** 2)))

    best = error(after, (), (), ())
    return {
        "true numbers, rad": best,
        "the old numbers": error(before, (), (), ()) / best,
        "one number": error(one, ["payload"], [0.005], [0.05]) / best,
        "ten numbers": error(before, names, list(0.003 * each), list(0.003 * each)) / best,
    }


TRAIN, STRIDE, WINDOW = (0, 7, 14, 21), 10, 21  # windows; samples a reading; samples of a polynomial


def reference(q: Array, h: float) -> Array:
    """Velocities (N, n) by local polynomials of degree 5; NaN at the ends."""
    half = WINDOW // 2
    powers = (h * np.arange(-half, half + 1))[:, None] ** np.arange(6)
    weights = np.linalg.pinv(powers)[1]
    found = np.full_like(q, np.nan)
    found[half:-half] = np.stack([np.convolve(x, weights[::-1], "valid") for x in q.T], -1)
    return found


def constant_acceleration(y: Array, h: float, sigma: float, jerk: float) -> Array:
    """Velocities (N,) of the Kalman filter of a constant acceleration."""
    A = np.array([[1, h, h * h / 2], [0, 1, h], [0, 0, 1]])
    Q = jerk**2 * np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h]])
    x, P, found = np.array([y[0], 0, 0]), np.diag([sigma**2, 1e2, 1e4]), []
    for now in y:
        x, P = A @ x, A @ P @ A.T + Q
        gain = P[:, 0] / (P[0, 0] + sigma**2)
        x, P = x + gain * (now - x[0]), P - np.outer(gain, P[0])
        found.append(x[1])
    return np.array(found)


def accelerated(y: Array, h: float, sensor: Array, jerk: float) -> Array:
    """Velocities (N, n) of the same filter for each coordinate, with the standard deviations of its sensor, (n,)."""
    columns = zip(y.T, sensor, strict=True)
    return np.stack([constant_acceleration(x, h, sigma, jerk) for x, sigma in columns], -1)


def measured(folder: Path) -> dict[str, Any]:
    """NIS and errors of velocities over the windows that did not train."""
    data = load(folder / "uw_double_pendulum" / "uw_double_pendulum_estimation.csv", show=False)
    run = fit(data.select(TRAIN), train_fraction=1.0, progress=False)
    test = [data.select([b]).q.double().numpy() for b in range(len(data)) if b not in TRAIN]
    h = data.typical_step
    model, steps, noise = run.model.double(), round(STRIDE * h / run.h), noise_of(run)
    sensor = np.array(noise.position)

    def followed(q: Array, adaptation: float) -> Followed:
        y, v = q[::STRIDE], (q[1] - q[0]) / h
        p = model.velocity_derivatives(torch.tensor(q[:1]), torch.tensor(v)[None], torch.zeros(1).double())[0][0]
        start = np.concatenate([y[0], p.detach().numpy()])
        std = [*sensor, 0.1, 0.1, *([0.0] * model.s_enters_motion)]
        return Followed(model, STRIDE * h, steps, y, [*sensor, *noise.momentum], std, start=start,
                        adaptation=adaptation)  # fmt: skip

    fixed, learned = ([followed(q, x).surprise[10:] for q in test] for x in (0.0, noise.adaptation))
    found = np.concatenate(learned)
    truth = [reference(q, h)[::STRIDE] for q in test]
    late = slice(10, -2)
    ours = np.concatenate([(followed(q, noise.adaptation).v - v)[late] for q, v in zip(test, truth, strict=True)])
    rms: dict[float, float] = {}
    for jerk in 10.0 ** np.arange(1.0, 6.01, 0.25):
        rivals = [accelerated(q[::STRIDE], STRIDE * h, sensor, jerk) for q in test]
        misses = [(rival - v)[late] for rival, v in zip(rivals, truth, strict=True)]
        rms[jerk] = float(np.sqrt(np.mean(np.concatenate(misses) ** 2)))
    best = min(rms, key=lambda jerk: rms[jerk])
    width = 1.96 * 2 / math.sqrt(len(found))
    return {
        "sensor, rad": sensor.round(7).tolist(),
        "forces, a root second": np.round(noise.momentum, 4).tolist(),
        "mean NIS of 2": float(found.mean()),
        "of a window": [f(float(x.mean()) for x in learned) for f in (min, max)],
        "with the noise of all windows": float(np.concatenate(fixed).mean()),
        "of a window then": [f(float(x.mean()) for x in fixed) for f in (min, max)],
        "its 95 % band": [2 - width, 2 + width],
        "samples in the 95 % interval of chi-squared": float(np.mean((found > 0.0506) & (found < 7.378))),
        "median NIS of 1.39": float(np.median(found)),
        "velocity, rad/s": float(np.sqrt(np.mean(ours**2))),
        "constant acceleration, rad/s": rms[best],
        "its jerk": float(best),
        "ratio": rms[best] / float(np.sqrt(np.mean(ours**2))),
        "speed, rad/s": float(np.sqrt(np.nanmean(np.concatenate(truth) ** 2))),
    }


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(__file__).resolve().parents[2] / "shared" / "data")
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    for seed in range(arguments.seeds):
        print(f"payload, seed {seed}:", {key: round(x, 4) for key, x in payload(seed).items()}, flush=True)
    if (arguments.data / "uw_double_pendulum").is_dir():
        for name, value in measured(arguments.data).items():
            print(f"measured, {name}: {value}")


if __name__ == "__main__":
    main()
