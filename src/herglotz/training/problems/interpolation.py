"""States at the nodes of a grid of segments, interpolated between the nodes of another grid or between samples."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.training.problems.grid import SegmentGrid


def between_nodes(
    grid: SegmentGrid,
    data: Trajectories,
    old_grid: SegmentGrid,
    old_data: Trajectories,
    states: Tensor,  # (S', K'+1, 2n+1) at the nodes of `old_grid`
) -> Tensor:
    """States (S, K+1, 2n+1) at the nodes of a grid, linear between the nodes of another grid of the same recordings."""
    old, new = old_grid.times(old_data), grid.times(data)
    values, x = states.flatten(0, 1), states.new_empty(*new.shape, states.shape[-1])
    old_owner, owner = old_data.trajectory[old_grid.start_sample], data.trajectory[grid.start_sample]
    for b in range(len(data)):
        rows, own = (old_owner == b).nonzero()[:, 0], (owner == b).nonzero()[:, 0]
        inside = torch.arange(old.shape[1], device=old.device) <= old_grid.end[rows, None]
        node = (rows[:, None] * old.shape[1] + torch.arange(old.shape[1], device=old.device))[inside]
        t, order = old[rows][inside].sort(stable=True)
        known = values[node[order]]
        at = torch.searchsorted(t, new[own].contiguous(), right=True).clamp(1, len(t) - 1)
        # Two segments meet at a joint, where the gap is 0 and the later segment counts.
        gap = t[at] - t[at - 1]
        share = torch.where(gap > 0, (new[own] - t[at - 1]) / torch.where(gap > 0, gap, 1.0), 1.0)[..., None]
        x[own] = known[at - 1] + share.clamp(0, 1) * (known[at] - known[at - 1])
    return x


def between_samples(grid: SegmentGrid, data: Trajectories, states: Tensor) -> Tensor:
    """States (S, K+1, 2n+1) at the nodes of a grid from states (N, 2n+1) at the samples, by cubic Hermite splines."""
    times = grid.times(data)
    owner, x = data.trajectory[grid.start_sample], states.new_empty(*times.shape, states.shape[-1])
    for b, (first, length) in enumerate(zip(data.offsets, data.lengths, strict=True)):
        t, known, own = data.t[first : first + length].contiguous(), states[first : first + length], owner == b
        at = torch.searchsorted(t, times[own].contiguous()).clamp(1, length - 1)
        h, rise = (t[at] - t[at - 1])[..., None], known[at] - known[at - 1]
        share = ((times[own] - t[at - 1])[..., None] / h).clamp(0, 1)
        slope = torch.gradient(known, spacing=(t,), dim=0)[0]
        bend = (1 - share) * (h * slope[at - 1] - rise) - share * (h * slope[at] - rise)
        x[own] = known[at - 1] + share * rise + share * (1 - share) * bend
    return x
