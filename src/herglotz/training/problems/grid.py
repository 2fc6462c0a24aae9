"""The grid of model steps of a recording, divided into segments: the bookkeeping of trajectory fitting."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.driving import InputPieces
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian

# Recorded steps of the shortest segments; every later stage doubles the length.
FIRST_SEGMENT = 20


@dataclass(frozen=True)
class SegmentGrid:
    """S segments of at most K model steps; shorter segments have padding at the end, which is never read.

    A recorded step longer than `max_step` becomes several equal model steps (nodes without a sample), so that a gap
    costs no accuracy. `node` is the flat index s·(K+1) + k of the node of each sample; `start_sample` the row of the
    data at the start of each segment, and `end` its last node; `joined` is True if a segment starts at the end of the
    one before, False at the start of a trajectory. Model step k is part of the recorded step that starts at `row`, with
    its middle at the share `part` of that step. `length` is the requested number of recorded steps of a segment.
    """

    h: Tensor  # (S, K)
    node: Tensor  # (N,)
    start_sample: Tensor  # (S,)
    joined: Tensor  # (S,) bool
    end: Tensor  # (S,)
    row: Tensor  # (S, K)
    part: Tensor  # (S, K)
    length: int

    @property
    def segments(self) -> int:
        """Number of segments S."""
        return self.h.shape[0]

    @property
    def longest(self) -> int:
        """Model steps of the longest segment."""
        return self.h.shape[1]

    @property
    def segment(self) -> Tensor:
        """The segment that observes each sample, (N,)."""
        return self.node // (self.longest + 1)

    def times(self, data: Trajectories) -> Tensor:
        """Time of every node, (S, K + 1), with padding."""
        first = data.t[self.start_sample][:, None]
        return torch.cat([first, first + self.h.cumsum(1)], 1)

    def at_samples(self, x: Tensor) -> Tensor:
        """Values at the samples, (N, …), from the values x at every node, (S, K + 1, …)."""
        return x.flatten(0, 1)[self.node]


class Grids:
    """Grids of a recording with the inputs of their model steps, (S, K, m), each made once.

    If the samples are some of another recording, `within` are the inputs of that one and the rows (N,) of these samples
    in it: a model step takes the mean of the inputs that were recorded in it.
    """

    def __init__(self, data: Trajectories, within: tuple[InputPieces, Tensor] | None = None):
        self.data, self.within = data, within
        self.made: dict[tuple[int, float], tuple[SegmentGrid, Tensor | None]] = {}

    def of(self, length: int, max_step: float) -> tuple[SegmentGrid, Tensor | None]:
        """As `segment_grid` divides the recording."""
        key = length, max_step
        if key not in self.made:
            grid = segment_grid(self.data, *key)
            self.made[key] = grid, self._inputs(grid)
        return self.made[key]

    def _inputs(self, grid: SegmentGrid) -> Tensor | None:
        """The inputs of the model steps of a grid, (S, K, m)."""
        if self.within is None:
            return self.data.inputs_of_steps(grid.row, grid.part)
        pieces, rows = self.within
        step = self.data.t[grid.row + 1] - self.data.t[grid.row]
        return pieces.means(rows[grid.row], grid.part * step - grid.h / 2, grid.h)


def step_inputs(model: ContactLagrangian, data: Trajectories, grid: SegmentGrid | None = None) -> Tensor | None:
    """Inputs of the steps that start at each sample, (N, m), or of the model steps of a grid, (S, K, m).

    None for a model without inputs. The last input of a trajectory acts on no step. Raise InputError if the data do not
    have the inputs of the model.
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
    """Segment lengths of the stages, in recorded steps: 20, 40, 80, …, and last whole trajectories.

    Lengths above two thirds of the longest trajectory are left out, since they divide no trajectory.
    """
    longest = max(data.lengths) - 1
    lengths = []
    length = FIRST_SEGMENT
    while round(longest / length) > 1:
        lengths.append(length)
        length *= 2
    return [*lengths, longest]


def segment_grid(data: Trajectories, length: int, max_step: float) -> SegmentGrid:
    """Divide each trajectory into segments of about `length` recorded steps.

    Segments of one trajectory have equal lengths up to one step. The last sample of a segment is the first of the next;
    only the earlier segment observes it.
    """
    recorded, device = data.t.double().cpu().diff(), data.t.device
    # Model steps of every recorded step, with a tolerance for rounded time stamps; none between two trajectories.
    counts = (recorded / max_step - 1e-6).ceil().clamp_min(1).long()
    counts[torch.tensor(data.offsets[1:], dtype=torch.long) - 1] = 0
    # Samples at which each segment starts and ends.
    starts: list[int] = []
    ends: list[int] = []
    for first, count in zip(data.offsets, data.lengths, strict=True):
        pieces = max(1, round((count - 1) / length))
        bounds = [first + round(i * (count - 1) / pieces) for i in range(pieces + 1)]
        starts += bounds[:-1]
        ends += bounds[1:]
    a, b = torch.tensor(starts), torch.tensor(ends)
    # Model steps before each sample.
    before = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    end = before[b] - before[a]
    K = int(end.max())
    # The last model step of a segment is its padding.
    step = before[a][:, None] + torch.arange(K).minimum(end[:, None] - 1)
    row = torch.arange(len(counts)).repeat_interleave(counts)[step]
    sample = torch.arange(data.samples)
    segment = torch.searchsorted(b, sample)
    return SegmentGrid(
        h=(recorded[row] / counts[row]).to(data.t),
        node=(segment * (K + 1) + before[sample] - before[a[segment]]).to(device),
        start_sample=a.to(device),
        joined=~torch.isin(a, torch.tensor(data.offsets)).to(device),
        end=end.to(device),
        row=row.to(device),
        part=(((step - before[row]).double() + 0.5) / counts[row]).to(data.t),
        length=length,
    )


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
