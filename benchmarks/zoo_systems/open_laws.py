"""`fixed_law(number, noise)`: six laws that no dictionary of terms holds, beside the draws of `open_systems.py`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.zoo_systems.drawing import PERIOD
from benchmarks.zoo_systems.mechanisms import Array
from benchmarks.zoo_systems.open_systems import OpenMechanism, crank, herglotz, linkage, recorded, single
from benchmarks.zoo_systems.systems import ZooSystem


def _two_magnets(q: Array) -> Array:
    """V′ of a pendulum, V = −cos θ, that passes above magnets at ±0.6 rad, −0.15 / distance each."""
    out = np.sin(q)
    for place in (-0.6, 0.6):
        apart = q - place
        out = out + 0.15 * np.sin(apart) / (0.1 + 2 * (1 - np.cos(apart))) ** 1.5
    return out


def _bouc_wen(q: Array, v: Array, w: Array, u: Array) -> tuple[Array, Array]:
    """Ẍ = −0.4 x − 0.6 w − 0.1 ẋ + u with ẇ = ẋ − 0.8 |ẋ| w − 0.4 ẋ |w|."""
    return -0.4 * q - 0.6 * w - 0.1 * v + u[:, None], v - 0.8 * np.abs(v) * w - 0.4 * v * np.abs(w)


def _two_masses(q: Array, v: Array, w: Array, u: Array) -> tuple[Array, Array]:  # noqa: ARG001
    """Two masses, 1 and 0.7, on springs 0.5 tanh(2.4 x) between walls, with a damper 0.1 tanh(3 v) between them."""
    first, last = 0.5 * np.tanh(2.4 * q[:, 0]), 0.5 * np.tanh(2.4 * q[:, 1])
    between = 0.5 * np.tanh(2.4 * (q[:, 1] - q[:, 0])) + 0.1 * np.tanh(3 * (v[:, 1] - v[:, 0]))
    f = np.stack([between - first, -between - last], -1) - 0.03 * v
    return f / np.array([1.0, 0.7]), w


# Each law: what makes its mechanism, whether it is driven, and its recorded step.
LAWS: tuple[tuple[Callable[[], OpenMechanism], bool, float], ...] = (
    (lambda: OpenMechanism("log cosh and a bump", 1, (False,), single(
        lambda x: 3 * np.tanh(3 * x) - 0.3 / 0.1**2 * (x - 0.4) * np.exp(-(((x - 0.4) / 0.1) ** 2) / 2),
        lambda q, v: (0.1 + 0.5 * np.exp(-q * q)) * v, 0.0), {}, (1.5, 1.5), "position"), False, 0.04),
    (lambda: OpenMechanism("slider-crank", 1, (True,), linkage(crank(0.5), 0.3, 0.0, 0.5, 0.03, 0.0), {},
                           (3.0, 2.5)), False, 0.1),
    (lambda: OpenMechanism("herglotz", 1, (False,), herglotz(
        lambda x: x * x / 2 + x**4 / 4, lambda x: x + x**3, 0.1, 0.15, 0.0), {}, (1.2, 1.0), "action", 1), False, 0.1),
    (lambda: OpenMechanism("two saturating springs", 2, (False, False), _two_masses, {}, (1.2, 0.6),
                           "tanh"), False, 0.1),
    (lambda: OpenMechanism("pendulum over magnets", 1, (True,), single(
        _two_magnets, lambda q, v: 0.08 * v, 0.0), {}, (2.0, 0.8)), False, 0.1),  # noqa: ARG005
    (lambda: OpenMechanism("Bouc-Wen", 1, (False,), _bouc_wen, {}, (0.5, 0.5), "hysteresis", 1),
     True, 0.1),
)  # fmt: skip


def fixed_law(number: int, noise: float) -> ZooSystem:
    """One of six laws (1 to 6) in six recordings of 240 samples, exact (noise 0) or with relative noise."""
    make, driven, h = LAWS[number - 1]
    rng = np.random.default_rng([61, number])
    found = recorded(rng, make(), (0, number), driven, PERIOD / h, (6, 240), noise, (1.0, 1.0))
    assert found is not None, "a fixed law moves"
    return found
