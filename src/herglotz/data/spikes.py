"""Gross errors in recorded positions: samples that no smooth motion explains, and readings of a sensor that stuck."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data.trajectories import Trajectories
from herglotz.data.windows import powers, pseudo_inverses

# A sample is compared with the polynomial of degree 3 through four neighbours on either side.
BESIDE, DEGREE = 4, 3
# A spike departs from that polynomial by more than all three of: so many times the RMS residual of the neighbours, so
# many times the noise of the whole trajectory, and this part of the standard deviation of the motion (quantisation is
# no gross error). tests/unit/data/test_spikes.py measures that no sample of smooth motion is a spike, with noise or
# without.
LOCAL, NOISE, SIZE = 6.0, 8.0, 0.01
# Noise above this part of the standard deviation of the motion: sampling is too coarse to judge.
MAX_NOISE = 0.1
# The worst spikes are removed and the rest is judged anew, at most this often.
MAX_PASSES = 10
# Equal readings after the first reading of a sensor that stuck: more than the runs below.
MIN_STUCK = 4
# The leap of a sensor that stuck is so many times the fastest step, because the leap makes up for two steps or more.
MIN_LEAP = 2.0
# Numbers of wrong samples in a row.
RUNS = (1, 2, 3)


def spikes(data: Trajectories) -> Tensor:
    """Return which samples are spikes, (N,) bool; never the first or last four samples of a trajectory.

    A sample (or a run of two or three) is compared with the cubic in time through eight neighbours (deleted residuals,
    Cook & Weisberg 1982). A spike exceeds the noise, and the misfit of the neighbours, so that fast smooth motion is
    kept. The worst spikes are removed and the rest is judged anew, until no spike is left. Spikes within four samples
    of each other may be overlooked; a robust loss helps there. Angles should be `unwrapped()`. Readings of a sensor
    that stuck (`_stuck`) are spikes, too.
    """
    found = _stuck(data)
    for first, length in zip(data.offsets, data.lengths, strict=True):
        rows = torch.arange(first, first + length, device=data.t.device)
        rows = rows[~found[rows]]
        size = SIZE * data.q[rows].std(0, correction=0).double()
        for run in RUNS:
            for _ in range(MAX_PASSES):
                bad = _worst(data.t[rows].double(), data.q[rows].double(), size, run)
                if not bool(bad.any()):
                    break
                found[rows[bad]] = True
                rows = rows[~bad]
    return found


def _stuck(data: Trajectories) -> Tensor:
    """Repeated readings of a sensor that stuck, (N,) bool: equal readings, then a leap to the present position.

    At least `MIN_STUCK` readings are equal, and the leap is `MIN_LEAP` times as fast as the fastest step between other
    readings: a body that friction holds leaves slowly, and a slow motion goes from count to count. A sensor that stands
    still in half of its steps is not judged.
    """
    found = torch.zeros(data.samples, dtype=torch.bool, device=data.t.device)
    for first, length in zip(data.offsets, data.lengths, strict=True):
        h = data.t[first : first + length].diff()
        for q in data.q[first : first + length].T:
            step = q.diff().abs() / h
            begin, end = _runs(step == 0)
            long = (end - begin >= MIN_STUCK) & (begin > 0) & (end < len(step))
            going = step.clone()
            going[end[long]] = 0
            leaps = long.clone()
            leaps[long] = (step[end[long]] > MIN_LEAP * going.max()) & (2 * int((going > 0).sum()) > len(step))
            for a, b in zip(begin[leaps].tolist(), end[leaps].tolist(), strict=True):
                found[first + a + 1 : first + b + 1] = True
    return found


def _runs(flags: Tensor) -> tuple[Tensor, Tensor]:
    """First place, and the place after the last, of each run of True."""
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
    c = pseudo_inverses(x[:, ~inside], DEGREE) @ values[:, ~inside]
    r = powers(x, DEGREE) @ c - values
    miss = r[:, inside].abs().amin(1)  # (W, n): the smallest departure in the run
    local = (r[:, ~inside].square().sum(1) / (2 * BESIDE - DEGREE - 1)).sqrt()
    noise = 1.4826 * r[:, inside].abs().amax(1).median(0).values
    limit = torch.maximum(torch.maximum(LOCAL * local, NOISE * noise), size)
    if bool((noise > MAX_NOISE * size / SIZE).any()):
        return torch.zeros_like(t, dtype=torch.bool)
    excess = (miss / limit.clamp_min(torch.finfo(q.dtype).tiny)).amax(1)
    highest = torch.nn.functional.max_pool1d(excess[None, None], 2 * window + 1, 1, window)[0, 0]
    found = torch.zeros_like(t, dtype=torch.bool)
    for first in ((excess > 1) & (excess == highest)).nonzero()[:, 0].tolist():
        found[first + BESIDE : first + BESIDE + run] = True
    return found
