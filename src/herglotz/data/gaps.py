"""Gaps in recordings: missing values, and gaps longer than all that was recorded, which begin another trajectory.

A sample with some positions keeps them: the others are interpolated, and have no weight in a fit. Errors are those of
samples whose positions were all read. A sample without any, or without another value, is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.missing import interpolated
from herglotz.data.trajectories import Trajectories
from herglotz.errors import refuse

Place = Callable[[int], str]  # of a sample in a file, in words
CROSSED = 1000  # typical steps: a gap of so many is crossed in any recording, as that costs little


def with_missing(data: Trajectories, known: Tensor, place: Place, lacking: Tensor | None = None) -> Trajectories:
    """Return the set with the positions that are `known`, (N, n) bool, alone; a note counts the others.

    Samples that are `lacking` another value, (N,) bool, or all positions are left out, and so are those before the
    first and after the last sample of a trajectory that has all; the note says the `place` of the first of them.
    """
    lacking = torch.zeros_like(known[:, 0]) if lacking is None else lacking
    missing = ~known.any(1) | lacking | ~_inside(known.all(1) & ~lacking, data.lengths)
    data = replace(data, observed=known.to(data.q))
    if count := int(missing.sum()):
        what = f"{'a row is' if count == 1 else f'{count} rows are'} left out, without a value"
        data = replace(data, notes=(*data.notes, f"{what}: the first is {place(int(missing.long().argmax()))}"))
        data = _trimmed(data, ~missing)
    assert data.observed is not None
    known = data.observed > 0
    if bool(known.all()):
        return replace(data, observed=None)
    counts = (f"{name} in {k}" for name, k in zip(data.names, (~known).sum(0).tolist(), strict=True) if k)
    note = f"missing positions, which have no weight in a fit: {', '.join(counts)} of {data.samples} rows"
    return replace(data, q=interpolated(data.t, data.q, known, data.lengths), notes=(*data.notes, note))


def complete(data: Trajectories) -> Trajectories:
    """Return the samples whose positions were all read; steps between them have the mean of their inputs.

    Trajectories that keep fewer than three are left out, unless all are.
    """
    if data.observed is None:
        return data
    counts = [int(own.sum()) for own in data.complete.split(data.lengths)]
    found = data.select(b for b, count in enumerate(counts) if count >= MIN_SAMPLES)
    return replace(_trimmed(found, found.complete) if len(found) else data, observed=None)


def _trimmed(data: Trajectories, kept: Tensor) -> Trajectories:
    """The set from the first to the last sample of each trajectory that is `kept`, (N,) bool, without the others.

    A step over these is longer, and has the mean of their inputs.
    """
    inside = _inside(kept, data.lengths)
    lengths = tuple(int(own.sum()) for own in inside.split(data.lengths))
    return data.rows(inside.nonzero()[:, 0], lengths).keep(kept[inside])


def _inside(kept: Tensor, lengths: tuple[int, ...]) -> Tensor:
    """Whether a sample is neither before the first nor behind the last of its trajectory that is `kept`, (N,) bool."""
    return torch.cat([(x.cumsum(0) > 0) & (x.flip(0).cumsum(0).flip(0) > 0) for x in kept.split(lengths)])


def parted(data: Trajectories) -> Trajectories:
    """Return the set with each trajectory cut where a step is longer than its samples would take at the typical step.

    Shorter gaps are crossed in model steps, which tie both sides to one motion; to cross these takes more steps than
    the recording has (a night at 0.05 s: hours of a fit), and no motion lasts. Parts of fewer than three samples are
    left out. A note says so.
    """
    steps, step = data.steps(), data.typical_step
    lengths = torch.tensor(data.lengths, device=data.t.device)
    cut = steps.h > step * lengths[steps.trajectory].clamp_min(CROSSED)
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
