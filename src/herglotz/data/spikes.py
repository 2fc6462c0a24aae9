"""Gross errors in recorded positions: samples that no smooth motion explains, and readings of a sensor that stuck."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data.trajectories import Trajectories
from herglotz.least_squares import least_squares

# A sample is compared with the polynomial of degree 3 through four neighbours on either side.
BESIDE, DEGREE = 4, 3
# A spike departs from that polynomial by more than all of these; tests/unit/data/test_spikes.py measures that nothing
# is left out of smooth motion, with noise or without.
LOCAL = 6.0  # times the RMS residual of the neighbours
NOISE = 8.0  # times the noise of the whole trajectory
SIZE = 0.01  # times the standard deviation of the motion: quantisation is no gross error
RESOLVED = 0.1  # times the standard deviation of the motion: above, sampling is too coarse to judge
PASSES = 10  # the worst spikes are removed and the rest is judged anew, at most this often
STUCK = 4  # equal readings behind the first, beyond the runs below
LEAP = 2.0  # times the fastest step: two steps in one
RUNS = (1, 2, 3)  # numbers of wrong samples in a row that are looked for


def spikes(data: Trajectories) -> Tensor:
    """Return which samples are spikes, (N,) bool; never the first or last four of a trajectory.

    A sample (or a run of two or three) is compared with the cubic in time through eight neighbours (deleted residuals,
    Cook & Weisberg 1982). A spike exceeds the misfit of the neighbours, so that fast smooth motion is kept, and the
    noise. The worst spikes are removed and the rest is judged anew, until none is left. Spikes within four samples of
    each other may be overlooked; for these use a robust loss. Angles should be `unwrapped()`. Readings that stand still
    while the motion goes on (`_stuck`) are left out, too.
    """
    found = _stuck(data)
    for first, length in zip(data.offsets, data.lengths, strict=True):
        rows = torch.arange(first, first + length, device=data.t.device)
        rows = rows[~found[rows]]
        size = SIZE * data.q[rows].std(0, correction=0).double()
        for run in RUNS:
            for _ in range(PASSES):
                bad = _worst(data.t[rows].double(), data.q[rows].double(), size, run)
                if not bool(bad.any()):
                    break
                found[rows[bad]] = True
                rows = rows[~bad]
    return found


def _stuck(data: Trajectories) -> Tensor:
    """Repeated readings of a sensor that stuck, (N,) bool: equal readings, then a leap to where the motion is.

    At least `STUCK` readings are equal, and the leap is `LEAP` times as fast as the fastest step between other
    readings: a body that friction holds leaves slowly, and a slow motion goes from count to count. A sensor that stands
    still in half of its steps is not judged.
    """
    found = torch.zeros(data.samples, dtype=torch.bool, device=data.t.device)
    for first, length in zip(data.offsets, data.lengths, strict=True):
        h = data.t[first : first + length].diff()
        for q in data.q[first : first + length].T:
            step = q.diff().abs() / h
            begin, end = _runs(step == 0)
            long = (end - begin >= STUCK) & (begin > 0) & (end < len(step))
            going = step.clone()
            going[end[long]] = 0
            leaps = long.clone()
            leaps[long] = (step[end[long]] > LEAP * going.max()) & (2 * int((going > 0).sum()) > len(step))
            for a, b in zip(begin[leaps].tolist(), end[leaps].tolist(), strict=True):
                found[first + a + 1 : first + b + 1] = True
    return found


def _runs(flags: Tensor) -> tuple[Tensor, Tensor]:
    """First and one past the last place of each run of True."""
    edges = torch.nn.functional.pad(flags.int(), (1, 1)).diff()
    return (edges > 0).nonzero()[:, 0], (edges < 0).nonzero()[:, 0]


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
