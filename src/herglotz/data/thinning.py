"""Every m-th sample only: less work where a motion is sampled far faster than it changes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from herglotz.errors import InputError

if TYPE_CHECKING:
    from herglotz.data.trajectories import Trajectories


def thinned(data: Trajectories, every: int) -> Trajectories:
    """Samples 0, m, 2m, … of every trajectory.

    An input acts from its sample to the next, so that of a long step is the mean of those it covers, weighted by
    their time: the impulse is kept.

    Raises
    ------
    InputError
        If `every` is not a whole number >= 1, or a trajectory keeps fewer than three samples.
    """
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise InputError(f"every must be a whole number >= 1, got {every!r}")
    spans = list(zip(data.offsets, data.lengths, strict=True))
    kept = [torch.arange(first, first + length, every) for first, length in spans]
    rows = torch.cat(kept).to(data.t.device)
    u = None
    if data.u is not None:
        u = torch.cat([_means(data.t[a : a + n], data.u[a : a + n], every) for a, n in spans])
    columns = {name: x[rows] for name in ("t", "q", "s", "p") if (x := getattr(data, name)) is not None}
    return replace(data, **columns, u=u, lengths=tuple(len(x) for x in kept))


def _means(t: Tensor, u: Tensor, every: int) -> Tensor:
    """Time-weighted means of u over the steps between kept samples, (kept, m); the last one acts on no step."""
    h = torch.cat([t.diff(), t.new_zeros(1)])
    block = torch.arange(len(t), device=t.device) // every
    impulse = u.new_zeros(int(block[-1]) + 1, u.shape[1]).index_add(0, block, u * h[:, None])
    time = h.new_zeros(len(impulse)).index_add(0, block, h)
    return torch.where(time[:, None] > 0, impulse / time.clamp_min(1e-300)[:, None], u[::every])
