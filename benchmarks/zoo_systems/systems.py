"""What the zoo hands to a method, and what it is judged on: recordings with their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.zoo_systems.mechanisms import Array, Mechanism

EXACT = 1e-4  # of the size of a motion: what "at the noise" means where there is no noise
TRAIN = 0.667  # of each training recording, in samples: the default of `fit`


@dataclass(frozen=True)
class Recording:
    """B motions of N samples at shared times, in natural units."""

    t: Array  # (N,)
    q: Array  # (B, N, n) with noise
    truth: Array  # (B, N, n)
    u: Array  # (B, N) input held from each sample to the next; zeros where there is none


@dataclass(frozen=True)
class ZooSystem:
    """One member of the zoo."""

    seed: int
    index: int
    mechanism: Mechanism
    fitted: Mechanism  # its structure, with the numbers fitted to the training part
    friction: str
    driven: bool
    samples_per_period: float
    noise: float  # relative to the standard deviation of each coordinate; 0: exact
    sigma: Array  # (n,) standard deviation of the noise
    size: Array  # (n,) standard deviation of the coordinates
    train: Recording
    test: Recording
    warmup: int  # leading samples of a test recording that the start state is read from
    length_unit: float  # what natural length and time are in the files
    time_unit: float
    attainable: float | None = None  # of an open system: error over the noise of its true equation from the warm-up

    @property
    def name(self) -> str:
        """What it is, in one line."""
        drive = ", driven" if self.driven else ""
        noise = f"{100 * self.noise:.1f} % noise" if self.noise else "exact"
        what = f"{self.mechanism.kind} {self.mechanism.n}, {self.friction}{drive}"
        return f"{what}, {self.samples_per_period:.0f}/period, {noise}"

    @property
    def floor(self) -> Array:
        """(n,) error that counts as the noise."""
        return np.maximum(self.sigma, EXACT * self.size)

    def facts(self) -> dict:
        """What describes the system, for JSON."""
        return {
            "name": self.name, "seed": self.seed, "index": self.index, "kind": self.mechanism.kind,
            "coordinates": self.mechanism.n, "friction": self.friction, "driven": self.driven,
            "samples_per_period": round(self.samples_per_period, 2), "noise": self.noise,
            "trajectories": len(self.train.q), "samples": self.train.q.shape[0] * self.train.q.shape[1],
            "values": {k: round(float(x), 6) for k, x in self.mechanism.values.items()},
        }  # fmt: skip
