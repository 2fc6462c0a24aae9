"""How sparsely a recording tells its motion: searches over sparse samples cost less, and see as long a time."""

from __future__ import annotations

import math

import torch

from herglotz.data.trajectories import Trajectories

THINNINGS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # tried until one misses too much
SMOOTH = 1e-3  # of the spread: what samples left out may miss by; a sine then has 14 samples a period
ENOUGH = 500  # samples that stay


def sparsest(data: Trajectories) -> int:
    """Return the largest m at which every m-th sample tells the motion.

    Cubics in time through two kept samples before and two behind miss those halfway between by less than a thousandth
    of the spread, RMS. Noise counts as motion: recordings that are noisier keep every sample.
    """
    spread = float(((data.q - data.q.mean(0)) / data.balance).square().mean().sqrt())
    found = 1
    for every in THINNINGS:
        if every * ENOUGH > data.samples or not _missed(data, every) <= SMOOTH * spread:
            break
        found = every
    return found


def _missed(data: Trajectories, every: int) -> float:
    """By how much such cubics miss, RMS over the balance; inf where no trajectory has four kept samples."""
    firsts = zip(data.offsets, data.lengths, strict=True)
    rows = torch.cat([torch.arange(first, first + length - 3 * every, every) for first, length in firsts])
    if not len(rows):
        return math.inf
    at, middle = rows[:, None] + every * torch.arange(4), rows + every + every // 2
    t, q = data.t.double().cpu(), (data.q / data.balance).double().cpu()
    times = t[at] - t[middle][:, None]
    own, other, same = times[:, :, None], times[:, None, :], torch.eye(4, dtype=torch.bool)
    weights = torch.where(same, 1.0, other / torch.where(same, 1.0, other - own)).prod(-1)  # Lagrange's, at 0
    return float(((weights[..., None] * q[at]).sum(1) - q[middle]).square().mean().sqrt())
