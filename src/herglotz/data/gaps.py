"""Gaps in recordings: missing values, and gaps longer than the whole recording, which begin another trajectory.

A sample with some positions keeps these positions; the missing positions are interpolated, and have no weight in a fit.
Errors of a fit are errors of samples whose positions were all read. A sample without any position, or without an input,
action or momentum, is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.holds import interpolated
from herglotz.data.trajectories import Trajectories
from herglotz.errors import refuse

# The place of a sample in a file, in words.
Place = Callable[[int], str]
# A gap of so many typical steps is crossed in any recording, because the model takes so many steps in little time.
MAX_CROSSED_STEPS = 1000
# Part of the note on inputs that were recorded more often than the motion, by which it is found among notes.
MEANS = "most steps have the mean of their inputs"


def with_missing(data: Trajectories, known: Tensor, place: Place, lacking: Tensor | None = None) -> Trajectories:
    """Return the set with only the positions that are `known`, (N, n) bool; a note counts the missing positions.

    Samples that are `lacking` another value, (N,) bool, or all positions are left out. So are the samples before the
    first and after the last complete sample of a trajectory. A note gives the `place` of the first sample left out.
    """
    lacking = torch.zeros_like(known[:, 0]) if lacking is None else lacking
    missing = ~known.any(1) | lacking | ~_inside(known.all(1) & ~lacking, data.lengths)
    data = replace(data, observed=known.to(data.q))
    if count := int(missing.sum()):
        what = f"{'a row is' if count == 1 else f'{count} rows are'} left out, without a value"
        first = f"the first is {place(int(missing.long().argmax()))}"
        means = data.u is not None and 2 * count > data.samples
        data = replace(data, notes=(*data.notes, f"{what}: {first}{f'; {MEANS}' if means else ''}"))
        data = _trimmed(data, ~missing)
    assert data.observed is not None
    known = data.observed > 0
    if bool(known.all()):
        return replace(data, observed=None)
    counts = (f"{name} in {k}" for name, k in zip(data.names, (~known).sum(0).tolist(), strict=True) if k)
    note = f"missing positions, which have no weight in a fit: {', '.join(counts)} of {data.samples} rows"
    return replace(data, q=interpolated(data.t, data.q, known, data.lengths), notes=(*data.notes, note))


def complete(data: Trajectories) -> Trajectories:
    """Return the samples whose positions were all read; a step over other samples has the mean of their inputs.

    Trajectories that keep fewer than three samples are left out, unless all trajectories do.
    """
    if data.observed is None:
        return data
    counts = [int(own.sum()) for own in data.complete.split(data.lengths)]
    found = data.select(b for b, count in enumerate(counts) if count >= MIN_SAMPLES)
    return replace(_trimmed(found, found.complete) if len(found) else data, observed=None)


def _trimmed(data: Trajectories, kept: Tensor) -> Trajectories:
    """The set with only the samples that are `kept`, (N,) bool.

    A step over other samples is longer, and has the mean of their inputs.
    """
    inside = _inside(kept, data.lengths)
    lengths = tuple(int(own.sum()) for own in inside.split(data.lengths))
    return data.rows(inside.nonzero()[:, 0], lengths).keep(kept[inside])


def _inside(kept: Tensor, lengths: tuple[int, ...]) -> Tensor:
    """Whether a sample is neither before the first nor after the last `kept` sample of its trajectory, (N,) bool."""
    return torch.cat([(x.cumsum(0) > 0) & (x.flip(0).cumsum(0).flip(0) > 0) for x in kept.split(lengths)])


def parted(data: Trajectories) -> Trajectories:
    """Return the set with each trajectory cut at steps longer than its number of samples times the typical step.

    Shorter gaps are crossed in model steps, which tie both sides to one motion. Longer gaps would take more steps than
    the recording has (a night at 0.05 s: hours of a fit), and no motion lasts so long. Parts of fewer than three
    samples are left out. A note counts the parts.
    """
    steps, step = data.steps(), data.typical_step
    lengths = torch.tensor(data.lengths, device=data.t.device)
    cut = steps.h > step * lengths[steps.trajectory].clamp_min(MAX_CROSSED_STEPS)
    if not bool(cut.any()):
        return data
    starts = steps.index[cut] + 1
    ends = torch.cat([starts, lengths.cumsum(0)]).unique()
    counts = ends.diff(prepend=ends.new_zeros(1))
    whole = counts >= MIN_SAMPLES
    rows = torch.arange(data.samples, device=data.t.device)[torch.repeat_interleave(whole, counts)]
    longest = f"gaps of up to {float(steps.h.max()):.4g}{'' if data.time_unit == '1' else f' {data.time_unit}'}"
    where = f"{data.source or 'trajectories'}: {longest} leave no part"
    refuse({f"{where} of {MIN_SAMPLES} samples; record without such gaps, or leave the samples beside them out":
            not bool(whole.any())})  # fmt: skip
    kept = tuple(counts[whole].tolist())
    left = f"; {len(whole) - len(kept)} too short, left out" if len(kept) < len(whole) else ""
    count = f"{len(kept)} trajector{'y' if len(kept) == 1 else 'ies'}"
    note = f"cut into {count} at {longest}{left}"
    return replace(data.rows(rows, kept), notes=(*data.notes, note))
