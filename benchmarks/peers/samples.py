"""What a peer is given: equally spaced positions, and velocities made from them or exact ones; held inputs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Indices = NDArray[np.int_]


@dataclass(frozen=True)
class Motion:
    """Points of phase space with their rates, all (N, n)."""

    q: Tensor
    v: Tensor  # velocity, or what stands for it
    p: Tensor  # momentum; equal to v where only positions were given
    a: Tensor  # dv/dt
    f: Tensor  # dp/dt
    u: Tensor | None = None  # (N, inputs) as the accelerations have felt them; None where nothing is driven


@dataclass(frozen=True)
class Samples:
    """Trajectories of one system, sampled every h."""

    q: tuple[Tensor, ...]  # positions of each trajectory, (K_i, n)
    h: float
    angles: tuple[bool, ...]  # which coordinates are 2π-periodic
    noisy: bool = False  # whether the positions carry noise: differences are then taken of a smoothed motion
    exact: tuple[Motion, ...] | None = None  # at the samples of each trajectory; None where positions only are given
    relative: bool = False  # whether the second coordinate of a double pendulum is the angle between its arms
    gaps: Tensor | None = None  # (K, n) where trajectories were cut: the recording on one grid, NaN where missing
    u: tuple[Tensor, ...] = ()  # (K_i, inputs) held from each sample to the next; empty where nothing is driven

    @property
    def dof(self) -> int:
        """Number of coordinates n."""
        return self.q[0].shape[1]

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        return self.u[0].shape[1] if self.u else 0

    def motions(self) -> tuple[Motion, ...]:
        """The exact motions where they were given, else differences of five neighbours, at their middle."""
        return self.exact or tuple(differences(q, self.h, self.noisy) for q in self.q if len(q) > 4)

    def motion(self) -> Motion:
        """All motions as one set of points."""
        parts = [vars(m) for m in self.motions()]
        rows: Any = {k: None if x is None else torch.cat([m[k] for m in parts]) for k, x in parts[0].items()}
        return Motion(**rows)

    def triples(self) -> tuple[Tensor, Tensor, Tensor]:
        """All three-sample windows, (N, n) each."""
        return self._adjacent(self.q, 3)  # type: ignore[return-value]

    def held(self) -> tuple[Tensor, Tensor]:
        """Inputs over both steps of each of the `triples`, (N, inputs) each."""
        u = self.u or tuple(q[:, :0] for q in self.q)
        return self._adjacent(tuple(x[:-1] for x in u), 2)  # type: ignore[return-value]

    @staticmethod
    def _adjacent(rows: tuple[Tensor, ...], count: int) -> tuple[Tensor, ...]:
        """The first, the second, … of all runs of `count` neighbours."""
        long = [x for x in rows if len(x) >= count]
        return tuple(torch.cat([x[k : len(x) - count + 1 + k] for x in long]) for k in range(count))

    def windows(self, length: int) -> Tensor:
        """Windows of `length` samples that overlap in one sample, (W, length, n)."""
        stride = length - 1
        return torch.cat([q.unfold(0, length, stride).transpose(1, 2) for q in self.q if len(q) >= length])


def differences(q: Tensor, h: float, noisy: bool) -> Motion:
    """Velocity and acceleration at the middle of every five samples, (K−4, n).

    Without noise of fourth order, from the polynomial through the five. With noise the slope and curvature of a fitted
    parabola (Savitzky & Golay, Analytical Chemistry 36:1627, 1964).
    """
    t = h * np.arange(len(q), dtype=np.float64)
    v, a = map(torch.as_tensor, local_polynomials(t, q.numpy(), np.arange(2, len(q) - 2), 2, 2 if noisy else 4)[1:])
    return Motion(q[2:-2], v, v, a, a)


def local_polynomials(t: Array, q: Array, at: Indices, half: int, degree: int) -> tuple[Array, Array, Array]:
    """Value, slope and curvature at some samples of polynomials through the 2 half + 1 nearest ones, (len(at), n) each.

    Near an end the nearest ones lie more on one side.
    """
    c = _inverse(t, at, half, degree) @ q[_nearest(t, at, half)]
    return c[:, 0], c[:, 1], 2 * c[:, 2]


def _nearest(t: Array, at: Indices, half: int) -> Indices:
    return np.clip(at - half, 0, len(t) - 2 * half - 1)[:, None] + np.arange(2 * half + 1)


def _inverse(t: Array, at: Indices, half: int, degree: int) -> Array:
    """(len(at), degree + 1, 2 half + 1): what takes samples to the coefficients of a polynomial in t − t[at]."""
    dt = t[_nearest(t, at, half)] - t[at][:, None]
    return np.linalg.pinv(np.stack([dt**k for k in range(degree + 1)], -1)).astype(np.float64)


def half_width(t: Array, q: Array, halves: tuple[int, ...], degree: int) -> int:
    """The half-width whose polynomials tell each sample best from its neighbours; q is (B, K, n).

    Leave-one-out cross-validation: a sample with the weight w in its own value is missed by (q − value) / (1 − w)
    without it. Source: J. Fan and I. Gijbels, Local Polynomial Modelling and Its Applications, 1996, section 4.
    """
    widest = max(half for half in halves if 2 * half < len(t) or half == min(halves))
    at = np.arange(widest, len(t) - widest)  # the same samples judge all widths

    def missed(half: int) -> float:
        inverse, near = _inverse(t, at, half, degree), _nearest(t, at, half)
        own = inverse[:, 0, half]
        errors = [(x[at] - (inverse @ x[near])[:, 0]) / (1 - own)[:, None] for x in q]
        return float(np.mean(np.square(errors) / q.reshape(-1, q.shape[-1]).var(0)))

    return min((half for half in halves if half <= widest), key=missed)
