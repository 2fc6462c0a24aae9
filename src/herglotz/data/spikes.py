"""Gross errors in recorded positions: one to three samples that no smooth motion through their neighbours explains."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from herglotz.data.trajectories import Trajectories

BESIDE = 4  # samples on either side that a sample is compared with
DEGREE = 3  # of the polynomial through them
LOCAL = 6.0  # a spike misses it by so many of the neighbours' own residuals,
NOISE = 8.0  # by so many of the noise all along the trajectory,
SIZE = 0.01  # and by this share of the motion's size: quantisation is no gross error
RESOLVED = 0.1  # shares of the motion's size that cubics may miss it by: coarser sampling is not judged
PASSES = 10
RUNS = (1, 2, 3)  # samples in a row


def spikes(data: Trajectories) -> Tensor:
    """Which samples are spikes, (N,) bool; never one of the first or last four of a trajectory.

    A sample (or a run of two or three) is compared with the cubic in time through its eight neighbours (deleted
    residuals, Cook & Weisberg 1982). It must stand out from the neighbours' misfit, so that fast but smooth motion is
    not taken for errors, and from the noise. The worst are taken out and the rest is judged anew, until none is left.
    Spikes within four samples of one another may hide each other: a robust loss is for those. Angles should be
    `unwrapped()`.
    """
    found = torch.zeros(data.samples, dtype=torch.bool, device=data.t.device)
    for first, length in zip(data.offsets, data.lengths, strict=True):
        rows = torch.arange(first, first + length, device=data.t.device)
        size = SIZE * data.q[rows].std(0, correction=0).double()
        for run in RUNS:
            for _ in range(PASSES):
                bad = _worst(data.t[rows].double(), data.q[rows].double(), size, run)
                if not bool(bad.any()):
                    break
                found[rows[bad]] = True
                rows = rows[~bad]
    return found


def without(data: Trajectories, dropped: Tensor) -> Trajectories:
    """The trajectories without these samples, (N,) bool; what is left out becomes a longer step.

    Its inputs are carried on: a long step takes the mean of those it covers, weighted by their time.
    """
    if not bool(dropped.any()):
        return data
    kept = ~dropped
    columns = {name: x[kept] for name in ("t", "q", "s", "p") if (x := getattr(data, name)) is not None}
    u = None if data.u is None else _held(data, kept)[kept]
    lengths = [int(part.sum()) for part in kept.split(list(data.lengths))]
    return replace(data, **columns, u=u, lengths=tuple(lengths))


def _held(data: Trajectories, kept: Tensor) -> Tensor:
    """Inputs averaged over the steps that start at kept samples, at every sample, (N, m)."""
    assert data.u is not None
    h = torch.cat([data.t.diff(), data.t.new_zeros(1)])
    h[[first + length - 1 for first, length in zip(data.offsets, data.lengths, strict=True)]] = 0
    group = kept.cumsum(0) - 1  # a trajectory's first sample is always kept
    time = h.new_zeros(int(group[-1]) + 1).index_add(0, group, h)
    impulse = data.u.new_zeros(len(time), data.u.shape[1]).index_add(0, group, data.u * h[:, None])
    mean = (impulse / time.clamp_min(torch.finfo(h.dtype).tiny)[:, None])[group]
    return torch.where((time > 0)[group][:, None], mean, data.u)


def _worst(t: Tensor, q: Tensor, size: Tensor, run: int) -> Tensor:
    """Runs of `run` spikes that are the worst among their neighbours, (N,) bool."""
    window = 2 * BESIDE + run
    if len(t) < window + 2:
        return torch.zeros_like(t, dtype=torch.bool)
    times, values = t.unfold(0, window, 1), q.unfold(0, window, 1).mT  # (W, window), (W, window, n)
    place = torch.arange(window, device=t.device)
    inside = (place >= BESIDE) & (place < BESIDE + run)
    x = times - times[:, BESIDE : BESIDE + 1]
    x = x / x.abs().amax(1, keepdim=True)
    A = torch.stack([x**k for k in range(DEGREE + 1)], -1)
    c = torch.linalg.lstsq(A[:, ~inside], values[:, ~inside]).solution
    r = A @ c - values
    miss = r[:, inside].abs().amin(1)  # (W, n): the least of the run
    local = (r[:, ~inside].square().sum(1) / (2 * BESIDE - DEGREE - 1)).sqrt()
    noise = 1.4826 * r[:, inside].abs().amax(1).median(0).values
    limit = torch.maximum(torch.maximum(LOCAL * local, NOISE * noise), size)
    if bool((noise > RESOLVED * size / SIZE).any()):
        return torch.zeros_like(t, dtype=torch.bool)
    excess = (miss / limit.clamp_min(torch.finfo(q.dtype).tiny)).amax(1)
    highest = torch.nn.functional.max_pool1d(excess[None, None], 2 * window + 1, 1, window)[0, 0]
    found = torch.zeros_like(t, dtype=torch.bool)
    for first in ((excess > 1) & (excess == highest)).nonzero()[:, 0].tolist():
        found[first + BESIDE : first + BESIDE + run] = True
    return found
