"""Estimates without a model: an upper bound on the noise of recordings, and a part of them that shows the motion."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from herglotz.data.checks import offsets_of
from herglotz.data.gaps import complete
from herglotz.data.splits import SHOWN
from herglotz.data.trajectories import Trajectories
from herglotz.data.windows import powers, pseudo_inverses

# A polynomial of this degree is fitted to so many samples in a row.
SAMPLES, DEGREE = SHOWN, 5
# Degrees of `precision`. Noise leaves the same residual at each degree; coarsely sampled motion leaves less at higher
# degrees.
DEGREES = (3, 5, 7)
# A residual is at the noise up to this factor times the precision: fitted states, and the estimate of the noise, leave
# 10 to 30 % more.
AT_THE_NOISE = 1.5
# Windows, evenly spread: more do not change an RMS.
MAX_WINDOWS = 4000


def roughness(data: Trajectories, degree: int = DEGREE) -> float:
    """Return the RMS residual of polynomials in time through nine samples in a row, in units of q over its balance.

    Independent noise of standard deviation σ gives σ; coarsely sampled motion gives more. Infinite if no trajectory has
    nine samples. Steps may differ. Angles should be `unwrapped()`.
    """
    return float(_residuals(data, degree).square().mean().sqrt())


def _residuals(data: Trajectories, degree: int) -> Tensor:
    """`roughness` of every coordinate, (n,), by its own readings."""
    q = data.q / data.balance
    if data.observed is None:
        return _of_readings(data.t, q, data.lengths, degree)
    each = []
    for x, known in zip(q.T, (data.observed > 0).T, strict=True):
        lengths = [int(own.sum()) for own in known.split(data.lengths)]
        each.append(_of_readings(data.t[known], x[known][:, None], lengths, degree))
    return torch.cat(each)


def _of_readings(t: Tensor, q: Tensor, lengths: Sequence[int], degree: int) -> Tensor:
    """`roughness` of each column of q (N, k), read at times t (N,) of trajectories of these lengths, (k,)."""
    firsts = [
        torch.arange(first, first + length - SAMPLES + 1)
        for first, length in zip(offsets_of(tuple(lengths)), lengths, strict=True)
        if length >= SAMPLES
    ]
    if not firsts:
        return torch.full((q.shape[1],), torch.inf, dtype=torch.float64)
    rows = torch.cat(firsts)
    rows = rows[:: -(-len(rows) // MAX_WINDOWS)].to(t.device)[:, None] + torch.arange(SAMPLES, device=t.device)
    t, q = t[rows].double().cpu(), q[rows].double().cpu()
    x = 2 * (t - t[:, :1]) / (t[:, -1:] - t[:, :1]) - 1
    inverses = pseudo_inverses(x, degree)
    r = q - powers(x[: len(inverses)], degree) @ (inverses @ q)
    return (r.square().mean((0, 1)) * SAMPLES / (SAMPLES - degree - 1)).sqrt()


def precision(data: Trajectories) -> float:
    """Standard deviation of the noise of q, estimated without a model; an upper bound for coarse data.

    inf if no trajectory has nine samples.
    """
    return min(roughness(data, degree) for degree in DEGREES)


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
    return torch.stack([_residuals(data, degree) for degree in DEGREES]).amin(0)


def part_of(data: Trajectories, most: int) -> Trajectories:
    """About `most` samples: every second, fourth … sample as long as polynomials follow the motion between them.

    The result is cut to the runs of samples that move most. Data with no more than `most` samples stay unchanged.
    Samples that lack positions are left out first: every m-th row may miss all rows of a slower sensor.
    """
    few = data if data.samples < 2 * most else complete(data)
    while few.samples >= 2 * most and min(few.lengths) >= 2 * most / len(few) and not coarse(half := few.thinned(2)):
        few = half
    liveliest = few.liveliest(most)
    return liveliest if liveliest.samples < few.samples / 2 else few
