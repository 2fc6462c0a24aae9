"""Every m-th sample only: less work where a motion is sampled far faster than it changes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from herglotz.errors import InputError


def kept_rows(lengths: Sequence[int], every: int) -> list[Tensor]:
    """Rows 0, m, 2m, … of every trajectory in the concatenation, a tensor a trajectory.

    Raises
    ------
    InputError
        If `every` is not a whole number >= 1.
    """
    if isinstance(every, bool) or not isinstance(every, int) or every < 1:
        raise InputError(f"every must be a whole number >= 1, got {every!r}")
    rows = torch.arange(sum(lengths)).split(list(lengths))
    return [own[::every] for own in rows]


def mean_inputs(
    t: Tensor,  # (N,) time
    u: Tensor,  # (N, m) input, which acts from its sample to the next
    lengths: Sequence[int],
    every: int,
) -> Tensor:
    """Return the time-weighted mean of u over each long step, (kept, m): the impulse is kept."""
    spans = zip(t.split(list(lengths)), u.split(list(lengths)), strict=True)
    return torch.cat([_means(own_t, own_u, every) for own_t, own_u in spans])


def _means(t: Tensor, u: Tensor, every: int) -> Tensor:
    """Time-weighted means of u over the steps between kept samples, (kept, m); the last one acts on no step."""
    h = torch.cat([t.diff(), t.new_zeros(1)])
    block = torch.arange(len(t), device=t.device) // every
    impulse = u.new_zeros(int(block[-1]) + 1, u.shape[1]).index_add(0, block, u * h[:, None])
    time = h.new_zeros(len(impulse)).index_add(0, block, h)
    return torch.where(time[:, None] > 0, impulse / time.clamp_min(1e-300)[:, None], u[::every])
