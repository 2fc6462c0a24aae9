"""Recorded samples laid on a grid of model steps, cut into segments: the bookkeeping of trajectory fitting."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian

FIRST_SEGMENT = 20  # recorded steps; later stages double it


@dataclass(frozen=True)
class SegmentGrid:
    """S segments of at most K model steps each; shorter ones are padded at the end and the padding is never read.

    A recorded step longer than `max_step` is crossed in several equal model steps (nodes without an observation), so
    that a gap does not cost accuracy.
    """

    h: Tensor  # (S, K) model steps
    node: Tensor  # (N,) flat index s·(K+1) + k of the node that each sample observes
    start_sample: Tensor  # (S,) row of the data at the start of each segment
    joined: Tensor  # (S,) bool, whether it starts where the segment before ends; else a trajectory starts there
    end: Tensor  # (S,) last node of each segment
    row: Tensor  # (S, K) row of the data at the start of the recorded step that each model step is part of
    part: Tensor  # (S, K) where in this recorded step the middle of the model step is, from 0 to 1
    length: int  # recorded steps of a segment that were asked for: the same length gives the same segments

    @property
    def segments(self) -> int:
        """Number of segments S."""
        return self.h.shape[0]

    @property
    def longest(self) -> int:
        """Model steps of the longest segment."""
        return self.h.shape[1]

    def times(self, data: Trajectories) -> Tensor:
        """Time of every node, (S, K + 1), also of those that pad a segment."""
        first = data.t[self.start_sample][:, None]
        return torch.cat([first, first + self.h.cumsum(1)], 1)

    def at_samples(self, x: Tensor) -> Tensor:
        """Values at the samples, (N, …) in their order, from those at every node, (S, K + 1, …)."""
        return x.flatten(0, 1)[self.node]


def step_inputs(model: ContactLagrangian, data: Trajectories, grid: SegmentGrid | None = None) -> Tensor | None:
    """Inputs of the steps that start at each sample, (N, m), or of the model steps of a grid, (S, K, m).

    None for a model that takes none. The last one of a trajectory acts on no step. Raise InputError if the model takes
    inputs and the data hold none, or another number of them.
    """
    if not model.inputs:
        return None
    where = data.source or "data"
    if data.u is None:
        raise InputError(
            f"{where}: the model is driven by {model.inputs} input(s), and none of these columns is one; name them: "
            "--inputs NAMES (inputs= in Python)"
        )
    if data.u.shape[1] != model.inputs:
        raise InputError(f"{where}: {data.u.shape[1]} input(s) u are recorded, the model takes {model.inputs}")
    return data.inputs_of_steps() if grid is None else data.inputs_of_steps(grid.row, grid.part)


def segment_lengths(data: Trajectories) -> list[int]:
    """Segment lengths of the stages: 20, 40, 80, … recorded steps, and at last each trajectory whole.

    A length of more than two thirds of the longest trajectory cuts none in two.
    """
    longest = max(data.lengths) - 1
    lengths = []
    length = FIRST_SEGMENT
    while round(longest / length) > 1:
        lengths.append(length)
        length *= 2
    return [*lengths, longest]


def segment_grid(data: Trajectories, length: int, max_step: float) -> SegmentGrid:
    """Cut each trajectory into segments of about `length` recorded steps.

    Segments of one trajectory have equal lengths up to one step, so that none is a stub. The last sample of a segment
    is the first of the next; it is observed once, by the earlier segment.
    """
    recorded, device = data.t.double().cpu().diff(), data.t.device
    counts = (recorded / max_step - 1e-6).ceil().clamp_min(1).long()  # model steps; a hair for rounded time stamps
    lines: list[tuple[Tensor, Tensor, Tensor]] = []  # of each segment: h, row and part of its model steps
    seen: list[Tensor] = []  # its observed nodes
    starts: list[int] = []
    joined: list[bool] = []
    for first, count in zip(data.offsets, data.lengths, strict=True):
        pieces = max(1, round((count - 1) / length))
        bounds = [first + round(i * (count - 1) / pieces) for i in range(pieces + 1)]
        for i, (a, b) in enumerate(pairwise(bounds)):
            joined.append(i > 0)
            starts.append(a)
            node = torch.cat([counts.new_zeros(1), counts[a:b].cumsum(0)])
            row = torch.arange(a, b).repeat_interleave(counts[a:b])
            before = torch.arange(len(row)) - node[row - a]
            lines.append((recorded[row] / counts[row], row, (before.double() + 0.5) / counts[row]))
            seen.append(node[i > 0 :])
    end = torch.tensor([len(row) for _, row, _ in lines])
    K = int(end.max())
    padding = torch.arange(K).minimum(end[:, None] - 1)  # the last model step again
    h, row, part = (
        torch.stack([x[at] for x, at in zip(each, padding, strict=True)]) for each in zip(*lines, strict=True)
    )
    return SegmentGrid(
        h=h.to(data.t),
        node=torch.cat([s * (K + 1) + node for s, node in enumerate(seen)]).to(device),
        start_sample=torch.tensor(starts, device=device),
        joined=torch.tensor(joined, device=device),
        end=end.to(device),
        row=row.to(device),
        part=part.to(data.t),
        length=length,
    )
