"""One number for a free run, and the four words for a fit."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from benchmarks.zoo_systems.mechanisms import Array
from benchmarks.zoo_systems.systems import ZooSystem

AT_NOISE = 1.5  # times the noise: RMS of the free run against noisy samples, where a perfect model has 1
USABLE = 0.1  # of the size of the motion
AT, USE, SAID, SILENT = OUTCOMES = ("at the noise", "usable", "said it failed", "failed silently")

Predictions = Mapping[str, tuple[Array, Array]]  # part → (prediction, data), each (N, n)


def score(of: ZooSystem, found: Predictions) -> float:
    """RMS error over the noise, the worse of the two parts; infinite where a sample was not reached."""
    return _worst(found, of.floor)


def relative(of: ZooSystem, found: Predictions) -> float:
    """RMS error over the size of the motion, the worse of the two parts."""
    return _worst(found, of.size)


def outcome(score: float, relative: float, said: bool) -> str:
    """One of `OUTCOMES`. `said`: whether the fit itself called its result a failure."""
    if score <= AT_NOISE:
        return AT
    if relative <= USABLE:
        return USE
    return SAID if said else SILENT


def _worst(found: Predictions, unit: Array) -> float:
    parts = []
    for prediction, data in found.values():
        error = np.where(np.isfinite(prediction), prediction, np.inf) - data
        parts.append(float(np.sqrt(np.mean(np.square(error / unit)))))
    return max(parts)
