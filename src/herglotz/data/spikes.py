"""Gross errors in recorded positions: one to three samples that no smooth motion through their neighbours explains."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data.trajectories import Trajectories
from herglotz.least_squares import least_squares

# A sample is compared with the polynomial of degree 3 through its four neighbours on either side.
BESIDE, DEGREE = 4, 3
# A spike departs from that polynomial by more than all of these; tests/unit/data/test_spikes.py measures that nothing
# is left out of smooth motion, with noise or without.
LOCAL = 6.0  # times the RMS residual of its neighbours
NOISE = 8.0  # times the noise of the whole trajectory
SIZE = 0.01  # times the standard deviation of the motion: quantisation is no gross error
RESOLVED = 0.1  # times the standard deviation of the motion: above, sampling is too coarse to judge
PASSES = 10  # the worst spikes are removed and the rest is judged anew, at most this often
RUNS = (1, 2, 3)  # numbers of wrong samples in a row that are looked for


def spikes(data: Trajectories) -> Tensor:
    """Return which samples are spikes, (N,) bool; none of the first or last four of a trajectory is one.

    A sample (or a run of two or three) is compared with the cubic in time through its eight neighbours (deleted
    residuals, Cook & Weisberg 1982). A spike exceeds the misfit of its neighbours, so that fast smooth motion is kept,
    and the noise. The worst spikes are removed and the rest is judged anew, until none is left. Spikes within four
    samples of one another may hide each other; a robust loss serves those. Angles should be `unwrapped()`.
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


def _worst(t: Tensor, q: Tensor, size: Tensor, run: int) -> Tensor:
    """Return the runs of `run` spikes that are the worst among their neighbours, (N,) bool."""
    window = 2 * BESIDE + run
    if len(t) < window + 2:
        return torch.zeros_like(t, dtype=torch.bool)
    times, values = t.unfold(0, window, 1), q.unfold(0, window, 1).mT  # (W, window), (W, window, n)
    place = torch.arange(window, device=t.device)
    inside = (place >= BESIDE) & (place < BESIDE + run)
    x = times - times[:, BESIDE : BESIDE + 1]
    x = x / x.abs().amax(1, keepdim=True)
    A = torch.stack([x**k for k in range(DEGREE + 1)], -1)
    c = least_squares(A[:, ~inside], values[:, ~inside])
    r = A @ c - values
    miss = r[:, inside].abs().amin(1)  # (W, n): the smallest departure in the run
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
