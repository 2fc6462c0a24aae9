"""What a peer is given: equally spaced positions, and velocities made from them or exact ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# Weights of five neighbours, in units of 1/h and 1/h². Fourth order for data without noise; the slope and curvature of
# a fitted parabola (Savitzky & Golay, Analytical Chemistry 36:1627, 1964) for data with noise.
DIFFERENCES = {
    False: ((1 / 12, -8 / 12, 0.0, 8 / 12, -1 / 12), (-1 / 12, 16 / 12, -30 / 12, 16 / 12, -1 / 12)),
    True: ((-2 / 10, -1 / 10, 0.0, 1 / 10, 2 / 10), (2 / 7, -1 / 7, -2 / 7, -1 / 7, 2 / 7)),
}


@dataclass(frozen=True)
class Motion:
    """Points of phase space with their rates, all (N, n)."""

    q: Tensor
    v: Tensor  # velocity, or what stands for it
    p: Tensor  # momentum; equal to v where only positions were given
    a: Tensor  # dv/dt
    f: Tensor  # dp/dt


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

    @property
    def dof(self) -> int:
        """Number of coordinates n."""
        return self.q[0].shape[1]

    def motion(self) -> Motion:
        """The exact motion where it was given, else differences of five neighbours, at their middle."""
        if self.exact is not None:
            return joined(self.exact)
        return joined(tuple(m for q in self.q if (m := differences(q, self.h, self.noisy)) is not None))

    def triples(self) -> tuple[Tensor, Tensor, Tensor]:
        """All three-sample windows, (N, n) each."""
        parts = [(q[:-2], q[1:-1], q[2:]) for q in self.q if len(q) > 2]
        return tuple(torch.cat(x) for x in zip(*parts, strict=True))  # type: ignore[return-value]

    def windows(self, length: int) -> Tensor:
        """Windows of `length` samples that overlap in one sample, (W, length, n)."""
        stride = length - 1
        return torch.cat([q.unfold(0, length, stride).transpose(1, 2) for q in self.q if len(q) >= length])


def joined(parts: tuple[Motion, ...]) -> Motion:
    """One set of points."""
    return Motion(*(torch.cat([getattr(m, name) for m in parts]) for name in ("q", "v", "p", "a", "f")))


def differences(q: Tensor, h: float, noisy: bool) -> Motion | None:
    """Velocity and acceleration at the middle of every five samples, (K−4, n); None for a shorter trajectory."""
    if len(q) < 5:
        return None
    first, second = (torch.tensor(w, dtype=q.dtype) for w in DIFFERENCES[noisy])
    five = q.unfold(0, 5, 1)  # (K−4, n, 5)
    v, a = five @ first / h, five @ second / h**2
    return Motion(q[2:-2], v, v, a, a)
