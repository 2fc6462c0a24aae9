"""The Kalman filter on a payload that changes and on a measured arm: `python benchmarks/filter.py`.

* payload: two links with motors, simulated; an encoder of 1 mrad at 100 Hz. After 10 s the second link is 30 % heavier.
  Errors of what is predicted a second ahead, 5 to 8.5 s later, over those of the filter that has the true numbers of
  the heavier arm all the time. One number, `between` the arm and one of twice the second link, wanders by 0.005 a root
  second, or each of the ten numbers that a payload changes by 0.003 of itself.
* measured: four windows of the UW double pendulum, of all energies, train; `hz.filter` follows the 22 others, of which
  it sees every tenth sample (50 Hz). The velocity that estimates are held beside is that of polynomials of degree 5
  over 21 samples of the recording (500 Hz). The other filter assumes a constant acceleration, with the noise in its
  jerk that serves it best. NIS is the squared innovation over its variance, with a scale of the noise that the filter
  learns, and with a fixed one.

`--data FOLDER` says where the measured set is.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import herglotz as hz
from herglotz.data import load
from herglotz.export import compile_c, noise_of
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.models.numbers import chosen, combined, values_of, with_values
from herglotz.stepping import State
from herglotz.stepping.filter import KalmanFilter, Noise

Array = np.ndarray[Any, Any]
# The simulated arm: two links of point masses, 0.3 m each; the first weighs 1 kg.
G, LENGTH, FIRST, SECOND, VISCOUS = 9.81, 0.3, 1.0, 0.8, (0.02, 0.01)
DT, PARTS, SENSOR = 0.01, 2, 1e-3  # s between samples; model steps in it; noise of a reading in rad
# The sample at which the load comes; those whose predictions count; how far these go.
CHANGE, FROM, TO, AHEAD = 1000, 1500, 1850, 100
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


def ahead(
    model: ContactLagrangian, y: Tensor, u: Tensor, noise: Noise, std: Tensor, names: Sequence[str]
) -> Tensor:  # fmt: skip
    """What the filter predicts for `AHEAD` samples after each of the samples `FROM` to `TO`."""
    h, found, zero = DT / PARTS, [], torch.zeros(2, dtype=torch.float64)
    stepper = compile_c(model, h=h, parameters=names)
    kalman = KalmanFilter(model, noise, names, stepper=stepper)
    belief = kalman.start(State(y[0], zero, zero[0]), std)
    for k in range(1, TO):
        for _ in range(PARTS):
            belief = kalman.predict(belief, h, u[k - 1])
        belief, _ = kalman.update(belief, y[k])
        if k >= FROM:
            own = stepper.with_parameters(dict(zip(kalman.names, belief.theta.tolist(), strict=True)))
            inputs = u[k : k + AHEAD].repeat_interleave(PARTS, 0)
            found.append(own.rollout(*belief.state, h=h, steps=PARTS * AHEAD, inputs=inputs).q[-1])
    return torch.stack(found)


def payload(seed: int) -> dict[str, float]:
    """Errors a second ahead, 5 to 8.5 s after the load came, over those with the true numbers."""
    make, t = np.random.default_rng(seed), DT * np.arange(TO + AHEAD)
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
        noise, first = Noise([SENSOR] * 2, [0.01] * 2, wander), [SENSOR, SENSOR, 0.05, 0.05, *std]
        predicted = ahead(model, torch.from_numpy(y), torch.from_numpy(u), noise, torch.tensor(first).double(), names)
        return float((predicted - torch.from_numpy(q[FROM + AHEAD : TO + AHEAD])).square().mean().sqrt())

    best = error(after, (), (), ())
    return {
        "true numbers, rad": best,
        "the old numbers": error(before, (), (), ()) / best,
        "one number": error(one, ["payload"], [0.005], [0.05]) / best,
        "ten numbers": error(before, names, list(0.003 * each), list(0.003 * each)) / best,
    }


# Windows that train; samples of the recording a sample of the filter; samples of a polynomial; samples before the
# first that counts.
TRAIN, STRIDE, WINDOW, LATE = (0, 7, 14, 21), 10, 21, 10


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
    run = hz.fit(data.select(TRAIN), train_fraction=1.0, progress=False)
    test = [data.select([b]).q.double().numpy() for b in range(len(data)) if b not in TRAIN]
    h, noise = data.typical_step, noise_of(run)
    seen = data.select(b for b in range(len(data)) if b not in TRAIN).thinned(STRIDE)
    sensor, late = np.array(noise.position), slice(LATE, -2)

    def followed(noise: Noise) -> tuple[list[Array], list[Array]]:
        """Squared innovations and velocities of each window, without the first samples."""
        found = hz.filter(run, seen, noise=noise)
        windows = [slice(a + LATE, a + k) for a, k in zip(seen.offsets, seen.lengths, strict=True)]
        return [found.surprise[w].numpy() for w in windows], [found.v[w][:-2].numpy() for w in windows]

    (fixed, _), (learned, velocities) = followed(noise._replace(adaptation=0.0)), followed(noise)
    found = np.concatenate(learned)
    truth = [reference(q, h)[::STRIDE] for q in test]
    ours = np.concatenate([v - x[late] for v, x in zip(velocities, truth, strict=True)])
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
