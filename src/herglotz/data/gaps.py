"""Recordings that were written into one: a gap longer than all that was recorded begins another."""

from __future__ import annotations

from dataclasses import replace

import torch

from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.trajectories import Trajectories

CROSSED = 1000  # typical steps: a gap of so many is crossed in any recording, as that costs little


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
    longest = float(steps.h.max())
    kept = tuple(counts[whole].tolist())
    left = f"; {len(whole) - len(kept)} too short, left out" if len(kept) < len(whole) else ""
    count = f"{len(kept)} trajector{'y' if len(kept) == 1 else 'ies'}"
    note = f"cut into {count} at gaps of up to {longest:.4g} {data.time_unit}{left}"
    return replace(data.rows(rows, kept), notes=(*data.notes, note))
