"""Free runs over segments by the compiled kernel, with derivatives that are summed into normal equations in pieces."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.models import ContactLagrangian
from herglotz.training.arrowhead import Sums
from herglotz.training.distributed import add_over_processes, processors, world
from herglotz.training.kernel import Placed, kernel_of
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import SegmentGrid

# Largest size of the rows of J of a piece, in bytes.
CHUNK_BYTES = 64 * 2**20
# Least number of samples that is worth a thread, and largest number of jobs that samples are divided into.
SAMPLES_PER_JOB, MAX_JOBS = 1000, 8


class Piece(NamedTuple):
    """Segments `first` ≤ k < `last`, or a part of one segment, that the kernel runs in one call.

    `steps` are where the model steps of each segment begin and end, `place` the node of its first state. `starts`:
    the piece begins at the start of its segments. Its samples are `samples` in number, from `offset` on.
    """

    first: int
    last: int
    steps: Tensor  # (last − first + 1,)
    place: Tensor  # (last − first,)
    starts: bool
    samples: int
    offset: int


class Observed(NamedTuple):
    """Data of the residuals r = weight (q − y) of samples, with Student's t of `freedom`, or least squares if 0."""

    y: Tensor  # (N, n)
    weight: Tensor  # (N, n)
    freedom: float


class CompiledFlow:
    """Free runs over the segments of a grid by a kernel; `divided` among the processes of `torchrun`, or in each."""

    def __init__(self, placed: Placed, grid: SegmentGrid, u: Tensor | None, n: int, *, divided: bool = False):
        self.placed, self.kernel, self.n = placed, placed.kernel, n
        self.rank, self.processes = world() if divided else (0, 1)
        S, K = grid.h.shape
        there = torch.arange(K) < grid.end[:, None]
        at = torch.full((S * (K + 1),), -1)
        at[grid.node] = torch.arange(len(grid.node))
        at = at.reshape(S, K + 1)
        self.first, self.sample = at[:, 0].contiguous(), at[:, 1:][there].contiguous()
        self.h, self.u = grid.h[there].contiguous(), None if u is None else u[there].contiguous()
        self.begin = torch.cat([torch.zeros(1, dtype=torch.long), grid.end.cumsum(0)])
        self.place, self.nodes = torch.arange(S) * (K + 1), (S, K + 1)
        seen = torch.cat([torch.zeros(1, dtype=torch.long), (self.sample >= 0).long().cumsum(0)])
        # seen[k]: how many of the first k steps end at a sample. counts[i]: samples of segment i.
        self.seen = seen
        self.counts = (seen[self.begin[1:]] - seen[self.begin[:-1]] + (self.first >= 0).long()).tolist()
        # Jobs by the width of a row of J; copies of this flow for other subsets of parameters share them.
        self.jobs: dict[int, list[list[Piece]]] = {}

    def run(
        self, theta: Tensor, starts: Tensor, of: Observed, sums: Sums | None = None, rows: Tensor | None = None
    ) -> Tensor | None:
        """States at all nodes (S, K+1, 2n+1) from `starts` (S, 2n+1); None if a step has no solution.

        The normal equations of the data are added to `sums`, and the derivatives of the positions at the samples, times
        their weights, to `rows` (N, n, P + d), both of no samples before.
        """
        whole = self.placed.rest.index_copy(0, self.placed.chosen, theta)
        ends, r = starts.contiguous().clone(), torch.zeros_like(of.y)
        delta, states = ends.new_zeros(len(ends), self.n), ends.new_zeros(*self.nodes, ends.shape[-1])
        d = self.kernel.d
        F = 0 if sums is None else len(sums.corner)
        chosen = self.placed.chosen[:F]

        def run_piece(piece: Piece) -> tuple[Piece, Tensor | None] | None:
            """The piece with its rows of J; None if a step has no solution."""
            own = slice(piece.first, piece.last)
            first = self.first[own] if piece.starts else torch.full_like(self.first[own], -1)
            derived, summed, J = (None, None), (None, None, None), None
            if sums is not None:
                J = ends.new_zeros(piece.samples * self.n, F + d)
                derived, summed = (sums.slopes[own], r), (sums.border[own], sums.blocks[own], sums.by_state[own])
            failed = self.kernel.sweep(
                piece.last - piece.first, piece.steps, self.h, self.u, whole, self.placed.constants, F, chosen,
                self.sample, first, of.y, of.weight, of.freedom, piece.offset, piece.place, ends[own], delta[own],
                states, *derived, J, *summed,
            )  # fmt: skip
            return None if failed >= 0 else (piece, J)

        def run_job(pieces: Sequence[Piece]) -> list[tuple[Piece, Tensor | None] | None]:
            """The pieces of a job in order, because parts of a segment follow one another, until a piece fails."""
            found = []
            for piece in pieces:
                found.append(run_piece(piece))
                if found[-1] is None:
                    break
            return found

        jobs, failed = self._jobs(0 if sums is None else F + d)[self.rank :: self.processes], ends.new_zeros(1)
        if sums is not None and self.processes > 1:
            mine = torch.zeros(len(ends), dtype=torch.bool)
            for job in jobs:
                mine[job[0].first : job[-1].last] = True
            sums.slopes[~mine] = 0.0
        for results in self._run(run_job, jobs):
            for result in results:
                if result is None:
                    failed += 1
                    break
                piece, J = result
                if sums is None or J is None:
                    continue
                part = slice(piece.offset, piece.offset + piece.samples)
                if rows is not None:
                    rows[part] = J.unflatten(0, (-1, self.n))
                by_theta = J[:, :F]
                sums.corner.addmm_(by_theta.T, by_theta)
                sums.by_theta.addmv_(by_theta.T, r[part].flatten())
            if failed:
                break
        if self.processes > 1:
            add_over_processes(failed, states, *(sums or ()), *(() if rows is None else (rows,)))
        return None if failed else states

    @staticmethod
    def _run(run_job: Callable, jobs: list[list[Piece]]) -> Iterator[list]:
        """The results of all jobs, in order; as many jobs run at once as there are processors.

        Memory grows with the number of processors. Sums do not depend on this number, because their order is fixed.
        """
        workers = min(len(jobs), processors())
        if workers < 2:
            yield from map(run_job, jobs)
            return
        for k in range(0, len(jobs), workers):
            yield from _pool(workers).map(run_job, jobs[k : k + workers])

    def _jobs(self, width: int) -> list[list[Piece]]:
        """The segments divided into jobs that can run at once, each with enough samples to be worth a thread."""
        if width not in self.jobs:
            S, total, found = len(self.place), sum(self.counts), []
            least, a, offset = max(SAMPLES_PER_JOB, total // MAX_JOBS), 0, 0
            while a < S:
                b, samples = a + 1, self.counts[a]
                while b < S and (samples < least or total - offset - samples < least):
                    samples += self.counts[b]
                    b += 1
                found.append(list(self._pieces(a, b, offset, width)))
                offset += samples
                a = b
            self.jobs[width] = found
        return self.jobs[width]

    def _pieces(self, a: int, last: int, offset: int, width: int) -> Iterator[Piece]:
        """Segments a ≤ k < `last` in pieces whose rows fit into `CHUNK_BYTES`; in one piece if there are no rows.

        A segment that is longer is divided into parts.
        """
        if not width:
            yield Piece(a, last, self.begin[a : last + 1], self.place[a:last], True, 0, 0)
            return
        most = max(1, CHUNK_BYTES // (8 * self.n * width))
        while a < last:
            b, samples = a + 1, self.counts[a]
            while b < last and samples + self.counts[b] <= most:
                samples += self.counts[b]
                b += 1
            if samples <= most:
                yield Piece(a, b, self.begin[a : b + 1], self.place[a:b], True, samples, offset)
            else:
                yield from self._parts(a, most, offset)
            offset += samples
            a = b

    def _parts(self, segment: int, most: int, offset: int) -> Iterator[Piece]:
        """A segment in parts of at most `most` model steps."""
        begin, end = self.begin[segment : segment + 2].tolist()
        for at in range(begin, end, most):
            to, starts = min(at + most, end), at == begin
            samples = int(self.seen[to] - self.seen[at]) + int(starts and self.first[segment] >= 0)
            place = self.place[segment : segment + 1] + (at - begin)
            yield Piece(segment, segment + 1, torch.tensor([at, to]), place, starts, samples, offset)
            offset += samples


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    """A pool of threads that stay, because starting threads takes as long as a sweep over a short recording."""
    return ThreadPoolExecutor(workers)


# The threads of the parent do not exist in a forked process.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


def motion(model: ContactLagrangian, start: Tensor, h: Tensor, u: Tensor | None) -> Tensor | None:
    """Free runs (S, K+1, 2n+1) from `start` (S, 2n+1) with steps h (S, K) and inputs u (S, K, m).

    None if the model has no kernel, or a step has no solution.
    """
    placed, (S, K) = kernel_of(model), h.shape
    if placed is None:
        return None
    none, end = torch.zeros(0, dtype=torch.long), torch.full((S,), K)
    grid = SegmentGrid(h, none, torch.zeros(S, dtype=torch.long), torch.zeros(S, dtype=torch.bool), end, end, h, K)
    flow = CompiledFlow(placed, grid, u, model.dof)
    empty = start.new_zeros(0, model.dof)
    return flow.run(ParameterVector(model).get(), start, Observed(empty, empty, 0.0))
