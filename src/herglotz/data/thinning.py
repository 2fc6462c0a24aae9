"""Samples left out of recorded motion: the inputs of the steps that become longer keep their impulse."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from herglotz.errors import InputError


def every_mth(lengths: Sequence[int], every: int) -> Tensor:
    """Return which samples are 0, m, 2m, … of their trajectory, (N,) bool.

    Raises
    ------
    InputError
        If `every` is not a whole number >= 1.
    """
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise InputError(f"every must be a whole number >= 1, got {every!r}")
    return torch.cat([torch.arange(length) % every == 0 for length in lengths])


def inputs_of_kept(
    t: Tensor,  # (N,) time
    u: Tensor,  # (N, m) inputs; each acts from its sample to the next
    lengths: Sequence[int],  # samples of each trajectory
    kept: Tensor,  # (N,) bool
) -> Tensor:
    """Return the time-weighted mean of u over the step that starts at each kept sample, (kept, m)."""
    h = torch.cat([t.diff(), t.new_zeros(1)])
    h[torch.tensor(lengths).cumsum(0) - 1] = 0  # no step starts at the last sample of a trajectory
    h = h * torch.cat([part.cumsum(0) > 0 for part in kept.split(tuple(lengths))])  # nor before the first one kept
    step = (kept.cumsum(0) - 1).clamp_min(0)
    time = h.new_zeros(int(step[-1]) + 1).index_add(0, step, h)
    impulse = u.new_zeros(len(time), u.shape[1]).index_add(0, step, u * h[:, None])
    mean = impulse / time.clamp_min(torch.finfo(h.dtype).tiny)[:, None]
    return torch.where(time[:, None] > 0, mean, u[kept])
