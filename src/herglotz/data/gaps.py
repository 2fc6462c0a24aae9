"""Gaps in recordings: samples without a value are left out; a gap longer than all that was recorded begins another."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.trajectories import Trajectories
from herglotz.errors import refuse

CROSSED = 1000  # typical steps: a gap of so many is crossed in any recording, as that costs little


def without(data: Trajectories, missing: Tensor, first: str) -> Trajectories:
    """Return the set without the samples that are `missing`, (N,) bool; a note counts them and names the `first`.

    A step over them is longer, and has the mean of their inputs. Each trajectory goes from its first known sample to
    its last one.
    """
    known = (~missing).split(list(data.lengths))
    inside = torch.cat([(own.cumsum(0) > 0) & (own.flip(0).cumsum(0).flip(0) > 0) for own in known])
    lengths = tuple(int(own.sum()) for own in inside.split(list(data.lengths)))
    found = data.rows(inside.nonzero()[:, 0], lengths).keep(~missing[inside])
    count = "a row is" if int(missing.sum()) == 1 else f"{int(missing.sum())} rows are"
    return replace(found, notes=(*data.notes, f"{count} left out, without a value: the first is {first}"))


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
