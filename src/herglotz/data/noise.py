"""Estimates without a model: an upper bound on the noise of recordings, and gross errors in recorded positions.

Gross errors are samples that no smooth motion explains, and readings of a sensor that stuck.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from herglotz.data.checks import offsets_of
from herglotz.data.gaps import complete
from herglotz.data.splits import MIN_SHOWING_NOISE
from herglotz.data.trajectories import Trajectories
from herglotz.data.windows import powers, pseudo_inverses, rounding

# A polynomial of this degree is fitted to so many samples in a row.
SAMPLES, DEGREE = MIN_SHOWING_NOISE, 5
# Degrees of `precision`. Noise leaves the same residual at each degree; coarsely sampled motion leaves less at higher
# degrees.
DEGREES = (3, 5, 7)
# A residual is at the noise up to this factor times the precision: fitted states, and the estimate of the noise, leave
# 10 to 30 % more.
AT_THE_NOISE = 1.5
# An outlier exceeds this many robust standard deviations, as a share of 6e-7 of normal residuals do.
TAIL = 5.0
# Windows, evenly spread: more do not change an RMS.
MAX_WINDOWS = 4000
# Roughnesses (D, n) of recordings by degrees: each is asked for a dozen times in a fit.
_KNOWN: WeakKeyDictionary[Trajectories, dict[tuple[int, ...], Tensor]] = WeakKeyDictionary()


def roughness(data: Trajectories, degree: int = DEGREE) -> float:
    """Return the RMS residual of polynomials in time through nine samples in a row, in units of q over its balance.

    Independent noise of standard deviation σ gives σ; coarsely sampled motion gives more. Infinite if no trajectory has
    nine samples. Steps may differ. Angles should be `unwrapped()`.
    """
    return float(_residuals(data, (degree,)).square().mean().sqrt())


def _residuals(data: Trajectories, degrees: tuple[int, ...]) -> Tensor:
    """`_residuals_of`, computed once for a recording."""
    known = _KNOWN.setdefault(data, {})
    if degrees not in known:
        known[degrees] = _residuals_of(data, degrees)
    return known[degrees]


def _residuals_of(data: Trajectories, degrees: tuple[int, ...]) -> Tensor:
    """`roughness` of every coordinate by its own readings, (D, n), of recordings that agree at one degree or more."""
    q = data.q / data.balance
    if data.observed is None:
        return _of_readings(data.t, q, data.lengths, degrees)
    each = []
    for x, known in zip(q.T, (data.observed > 0).T, strict=True):
        lengths = [int(own.sum()) for own in known.split(data.lengths)]
        each.append(_of_readings(data.t[known], x[known][:, None], lengths, degrees))
    return torch.cat(each, 1)


def _of_readings(t: Tensor, q: Tensor, lengths: Sequence[int], degrees: Sequence[int]) -> Tensor:
    """`roughness` of each column of q (N, k), read at times t (N,) of trajectories of these lengths, (D, k)."""
    firsts = [
        torch.arange(first, first + length - SAMPLES + 1)
        for first, length in zip(offsets_of(tuple(lengths)), lengths, strict=True)
        if length >= SAMPLES
    ]
    if not firsts:
        return torch.full((len(degrees), q.shape[1]), torch.inf, dtype=torch.float64)
    rows, of = torch.cat(firsts), torch.cat([torch.full_like(own, b) for b, own in enumerate(firsts)])
    stride = -(-len(rows) // MAX_WINDOWS)
    rows, of = rows[::stride].to(t.device)[:, None] + torch.arange(SAMPLES, device=t.device), of[::stride]
    t, q = t[rows].double().cpu(), q[rows].double().cpu()
    span = t[:, -1:] - t[:, :1]
    x = 2 * (t - t[:, :1]) / span - 1
    squares = []
    for degree in degrees:
        inverses = pseudo_inverses(x, degree, rounding(t, span / 2))
        squares.append((q - powers(x[: len(inverses)], degree) @ (inverses @ q)).square())
    agree = torch.stack([torch.stack([_agree(own, of) for own in square.mean(1).T], 1) for square in squares])
    # Coarse motion is rough at low degrees alone, noise at all of them. One degree does not tell them apart.
    good = agree.any(0).double() if len(degrees) > 1 else torch.ones_like(squares[0][:, 0])
    means = [(square * good[:, None]).mean((0, 1)) / good.mean(0) for square in squares]
    left = [mean * SAMPLES / (SAMPLES - degree - 1) for mean, degree in zip(means, degrees, strict=True)]
    return torch.stack(left).sqrt()


def _agree(square: Tensor, of: Tensor) -> Tensor:
    """Windows, (W,) bool, of recordings whose RMS residual is no outlier (`TAIL`) among three or more recordings.

    `square` (W,) are mean squares of residuals, `of` (W,) the recordings. A recording whose sensor stands still tells
    nothing about the noise.
    """
    mean = torch.bincount(of, square) / torch.bincount(of).clamp_min(1)
    known = mean[mean > 0]
    most = TAIL**2 * float(known.median()) if len(known) >= 3 else torch.inf
    return mean[of] <= most


def precision(data: Trajectories) -> float:
    """Standard deviation of the noise of q, estimated without a model; an upper bound for coarse data.

    Of three or more recordings those count whose roughness is no outlier: one of something else would set the noise of
    all. inf if no trajectory has nine samples.
    """
    return float(_residuals(data, DEGREES).square().mean(1).sqrt().min())


def spread(data: Trajectories) -> float:
    """Return the RMS of the positions about their means, in units of q."""
    return float((data.q - data.q.mean(0)).square().mean().sqrt())


def relative_spread(data: Trajectories) -> float:
    """`spread` of the positions over their balance."""
    return float(((data.q - data.q.mean(0)) / data.balance).square().mean().sqrt())


def coarse(data: Trajectories) -> bool:
    """Whether `precision` is an error of the polynomials and not noise: the highest degree still halves the residual.

    The residuals of white noise at the two highest degrees agree within a tenth.
    """
    *_, lower, highest = (roughness(data, degree) for degree in DEGREES)
    return highest < lower / 2


def precisions(data: Trajectories) -> Tensor:
    """`precision` of every coordinate, (n,)."""
    return _residuals(data, DEGREES).amin(0)


def part_of(data: Trajectories, most: int) -> tuple[Trajectories, Tensor]:
    """About `most` samples, and their rows in the data: every second, fourth … sample as long as polynomials follow.

    The result is cut to the runs of samples that move most. Data with no more than `most` samples stay unchanged.
    Samples that lack positions are left out first: every m-th row may miss all rows of a slower sensor.
    """
    every = torch.arange(data.samples, device=data.t.device)
    # The numbers of the rows take the place of s, which goes with its sample.
    numbered = replace(data, s=every.to(data.t))
    few = numbered if data.samples < 2 * most else complete(numbered)
    # Of many short recordings a few say more than some samples of each.
    least = 2 * max(most / len(data), SAMPLES)
    while few.samples >= 2 * most and min(few.lengths) >= least and not coarse(half := few.thinned(2)):
        few = half
    liveliest = few.liveliest(most)
    few = liveliest if liveliest.samples < few.samples / 2 else few
    if few is numbered:
        return data, every
    rows = cast(Tensor, few.s).long()
    return replace(few, s=None if data.s is None else data.s[rows]), rows


# A sample is compared with the polynomial of degree 3 through four neighbours on either side.
BESIDE, SPIKE_DEGREE = 4, 3
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
    half = x.abs().amax(1, keepdim=True)
    x = x / half
    inverses = pseudo_inverses(x[:, ~inside], SPIKE_DEGREE, rounding(t, half))
    r = powers(x[: len(inverses)], SPIKE_DEGREE) @ (inverses @ values[:, ~inside]) - values
    miss = r[:, inside].abs().amin(1)  # (W, n): the smallest departure in the run
    local = (r[:, ~inside].square().sum(1) / (2 * BESIDE - SPIKE_DEGREE - 1)).sqrt()
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
