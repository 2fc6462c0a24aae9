"""Interpolation of missing positions from the readings of the same coordinate."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data.holds import lagrange

# Readings through which a cubic gives the value between them.
CUBIC_POINTS = 4


def interpolated(t: Tensor, q: Tensor, known: Tensor, lengths: tuple[int, ...]) -> Tensor:
    """Positions (N, n); those that are not `known`, (N, n) bool, are on cubics through the known positions."""
    q = q.clone()
    for x, own in zip(q.T, known.T, strict=True):
        for time, part, read in zip(t.split(lengths), x.split(lengths), own.split(lengths), strict=True):
            if bool(read.any()):
                part[~read] = between(time[read], part[read], time[~read])
    return q


def between(t: Tensor, x: Tensor, at: Tensor) -> Tensor:
    """Values (M,) at other times of cubics through the nearest four readings (t, x), or through all if fewer."""
    count = min(CUBIC_POINTS, len(t))
    first = (torch.searchsorted(t, at) - count // 2).clamp(0, len(t) - count)
    near = first[:, None] + torch.arange(count, device=t.device)
    return (lagrange(t[near] - at[:, None]) * x[near]).sum(1)


def last_read(q: Tensor, known: Tensor, trajectory: Tensor) -> Tensor:
    """Positions (N, n); in place of a position that is not `known`, (N, n) bool, stands the last known position."""
    row = torch.arange(len(q), device=q.device)[:, None]
    first = torch.searchsorted(trajectory, trajectory)[:, None]
    return q.gather(0, torch.where(known, row, first).cummax(0).values)
