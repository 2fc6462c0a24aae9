"""Recorded samples laid on a grid of model steps, cut into segments: the bookkeeping of trajectory fitting."""

from __future__ import annotations

import math
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
    node: Tensor  # (N',) flat index s·(K+1) + k of every observed node
    sample: Tensor  # (N',) row of the data observed there
    start_sample: Tensor  # (S,) row of the data at the start of each segment
    joined_to: Tensor  # (S,) the segment whose end is this one's start, −1 at the start of a trajectory
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
        return x.flatten(0, 1)[self.node[self.sample.argsort()]]

    def start_trajectory(self, data: Trajectories) -> Tensor:
        """Trajectory of every segment, (S,)."""
        return data.trajectory[self.start_sample]


def step_inputs(model: ContactLagrangian, data: Trajectories, grid: SegmentGrid | None = None) -> Tensor | None:
    """Inputs of the steps that start at each sample, (N, m), or of the model steps of a grid, (S, K, m).

    None for a model that takes none. Between samples inputs do what the `hold` of the data says
    (`herglotz.data.holds`), by default nothing. The last one of a trajectory acts on no step.

    Raises
    ------
    InputError
        If the model takes inputs and the data hold none, or another number of them.
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


def substeps(h: float, max_step: float) -> int:
    """In how many equal model steps a recorded step is crossed (a hair of tolerance for rounded time stamps)."""
    return max(1, math.ceil(h / max_step - 1e-6))


def _steps(
    times: list[float], a: int, b: int, max_step: float
) -> tuple[list[float], list[int], list[float], list[int]]:
    """Model steps from sample a to b, the row and the middle of each, and the node of every sample after a."""
    line: list[float] = []
    rows: list[int] = []
    middle: list[float] = []
    ends: list[int] = []
    for j in range(a, b):
        m = substeps(times[j + 1] - times[j], max_step)
        line += [(times[j + 1] - times[j]) / m] * m
        rows += [j] * m
        middle += [(k + 0.5) / m for k in range(m)]
        ends.append(len(line))
    return line, rows, middle, ends


def segment_grid(data: Trajectories, length: int, max_step: float) -> SegmentGrid:
    """Cut each trajectory into segments of about `length` recorded steps.

    Segments of one trajectory have equal lengths up to one step, so that none is a stub. The last sample of a segment
    is the first of the next; it is observed once, by the earlier segment.
    """
    steps: list[list[float]] = []
    rows: list[list[int]] = []
    parts: list[list[float]] = []
    nodes: list[list[tuple[int, int]]] = []  # (k, sample) of the observed nodes
    starts: list[int] = []
    joined: list[int] = []
    times = data.t.tolist()
    for first, count in zip(data.offsets, data.lengths, strict=True):
        pieces = max(1, round((count - 1) / length))
        bounds = [first + round(i * (count - 1) / pieces) for i in range(pieces + 1)]
        for i, (a, b) in enumerate(pairwise(bounds)):
            joined.append(-1 if i == 0 else len(starts) - 1)
            starts.append(a)
            line, from_row, middle, ends = _steps(times, a, b, max_step)
            seen = [(0, a)] if i == 0 else []
            seen += zip(ends, range(a + 1, b + 1), strict=True)
            steps.append(line)
            rows.append(from_row)
            parts.append(middle)
            nodes.append(seen)
    K = max(len(line) for line in steps)
    padded, padded_rows, padded_parts = (
        [line + [line[-1]] * (K - len(line)) for line in lines] for lines in (steps, rows, parts)
    )
    device = data.t.device
    return SegmentGrid(
        h=torch.tensor(padded, dtype=data.t.dtype, device=device),
        node=torch.tensor([s * (K + 1) + k for s, seen in enumerate(nodes) for k, _ in seen], device=device),
        sample=torch.tensor([j for seen in nodes for _, j in seen], device=device),
        start_sample=torch.tensor(starts, device=device),
        joined_to=torch.tensor(joined, device=device),
        end=torch.tensor([len(line) for line in steps], device=device),
        row=torch.tensor(padded_rows, device=device),
        part=torch.tensor(padded_parts, dtype=data.t.dtype, device=device),
        length=length,
    )
