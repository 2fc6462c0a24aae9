"""Motions of segments with their derivatives by the compiled kernel, added up to normal equations piece by piece."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.training.kernel import Placed
from herglotz.training.problems.grid import SegmentGrid
from herglotz.training.sums import Sums

CHUNK = 64 * 2**20  # bytes of rows of J at once


class Piece(NamedTuple):
    """Segments, or a part of one, that are run at once."""

    first: int  # segment
    last: int
    steps: Tensor  # (last − first + 1,) where their model steps begin and end
    place: Tensor  # (last − first,) node of the first state
    starts: bool  # whether it has the starts of its segments
    samples: int  # that are observed
    offset: int  # the first of them


class Observed(NamedTuple):
    """What residuals of samples are made of: r = weight (q − y), with Student's t of `freedom` where that is not 0."""

    y: Tensor  # (N, n)
    weight: Tensor  # (N, n)
    freedom: float


class CompiledFlow:
    """Free runs over the segments of a grid by a kernel."""

    def __init__(self, placed: Placed, grid: SegmentGrid, u: Tensor | None, sharpest: Tensor | None, n: int):
        self.placed, self.kernel, self.n = placed, placed.kernel, n
        self.sharpest = placed.rest.new_zeros(n) if sharpest is None else sharpest.contiguous()
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
        self.seen = seen  # how many of the first steps end at a sample
        self.counts = (seen[self.begin[1:]] - seen[self.begin[:-1]] + (self.first >= 0).long()).tolist()

    def run(
        self, theta: Tensor, starts: Tensor, of: Observed, sums: Sums | None = None, rows: Tensor | None = None
    ) -> Tensor | None:
        """States at all nodes (S, K+1, 2n+1) from `starts` (S, 2n+1); None where a step has no solution.

        With `sums` the normal equations of the data are added to it; with `rows` (N, n, P + d) the derivatives of the
        positions at the samples are written, times their weights.
        """
        whole = self.placed.rest.index_copy(0, self.placed.chosen, theta)
        ends, r = starts.contiguous().clone(), torch.zeros_like(of.y)
        delta, states = ends.new_zeros(len(ends), self.n), ends.new_zeros(*self.nodes, ends.shape[-1])
        d = 2 * self.n
        F = 0 if sums is None else len(sums.corner)
        chosen = self.placed.chosen[:F]
        for piece in self._pieces(0 if sums is None else F + d):
            own = slice(piece.first, piece.last)
            first = self.first[own] if piece.starts else torch.full_like(self.first[own], -1)
            derived, sent, made = (None, None), (None, None, None), None
            if sums is not None:
                made = ends.new_zeros(piece.samples * self.n, F + d)
                derived, sent = (sums.slopes[own], r), (sums.border[own], sums.blocks[own], sums.by_state[own])
            failed = self.kernel.sweep(
                piece.last - piece.first, piece.steps, self.h, self.u, whole, self.sharpest, F, chosen, self.sample,
                first, of.y, of.weight, of.freedom, piece.offset, piece.place, ends[own], delta[own], states, *derived,
                made, *sent,
            )  # fmt: skip
            if failed >= 0:
                return None
            if sums is not None and made is not None:
                part = slice(piece.offset, piece.offset + piece.samples)
                if rows is not None:
                    rows[part] = made.unflatten(0, (-1, self.n))
                mine = made[:, :F]
                sums.corner.addmm_(mine.T, mine)
                sums.by_theta.addmv_(mine.T, r[part].flatten())
        return states

    def _pieces(self, width: int) -> Iterator[Piece]:
        """Segments whose rows fit into `CHUNK` bytes, and parts of one that is longer; all at once without rows."""
        S = len(self.place)
        if not width:
            yield Piece(0, S, self.begin, self.place, True, 0, 0)
            return
        most, a, offset = max(1, CHUNK // (8 * self.n * width)), 0, 0
        while a < S:
            b, samples = a + 1, self.counts[a]
            while b < S and samples + self.counts[b] <= most:
                samples += self.counts[b]
                b += 1
            if samples <= most:
                yield Piece(a, b, self.begin[a : b + 1], self.place[a:b], True, samples, offset)
            else:
                yield from self._parts(a, most, offset)
            offset += samples
            a = b

    def _parts(self, segment: int, most: int, offset: int) -> Iterator[Piece]:
        """A segment in parts of at most so many model steps."""
        begin, end = self.begin[segment : segment + 2].tolist()
        for at in range(begin, end, most):
            to, starts = min(at + most, end), at == begin
            samples = int(self.seen[to] - self.seen[at]) + int(starts and self.first[segment] >= 0)
            place = self.place[segment : segment + 1] + (at - begin)
            yield Piece(segment, segment + 1, torch.tensor([at, to]), place, starts, samples, offset)
            offset += samples
