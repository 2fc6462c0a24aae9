"""Sums over the rows of J and the residuals of multiple shooting, segment by segment."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.training.problems.grid import SegmentGrid


class Sums(NamedTuple):
    """JᵀJ and Jᵀr of the data in blocks, and the derivatives `slopes` of the ends of segments."""

    corner: Tensor  # (P, P)
    border: Tensor  # (S, d, P)
    blocks: Tensor  # (S, d, d)
    by_theta: Tensor  # (P,) Jᵀr
    by_state: Tensor  # (S, d)
    slopes: Tensor  # (S, d, P + d)

    @classmethod
    def zeros(cls, P: int, S: int, d: int, like: Tensor) -> Sums:
        """Sums of no rows."""
        slopes = like.new_zeros(S, d, P + d)
        slopes[..., P:] = torch.eye(d, dtype=like.dtype, device=like.device)
        zero = like.new_zeros
        return cls(zero(P, P), zero(S, d, P), zero(S, d, d), zero(P), zero(S, d), slopes)

    def add_samples(self, grid: SegmentGrid, Z: Tensor, by: Tensor, r: Tensor) -> None:
        """Add the rows by · ∂q of the samples, with residuals r (N, n), from derivatives Z (S, K+1, d, P + d) at nodes.

        This sets `slopes` too.
        """
        P, n = len(self.corner), r.shape[1]
        rows, segment = Z.flatten(0, 1)[grid.node][:, :n] * by[..., None], grid.node // (grid.h.shape[1] + 1)
        for k in range(grid.segments):
            own, right = rows[segment == k].flatten(0, 1), r[segment == k].flatten()
            by_theta, by_state = own[:, :P], own[:, P:]
            self.corner.addmm_(by_theta.T, by_theta)
            self.by_theta.addmv_(by_theta.T, right)
            self.border[k] += by_state.T @ by_theta
            self.blocks[k] += by_state.T @ by_state
            self.by_state[k] += by_state.T @ right
        self.slopes.copy_(Z[torch.arange(grid.segments, device=Z.device), grid.end])

    def add_joints(self, to: Tensor, by: Tensor, r: Tensor, own: Tensor | None = None) -> Tensor:
        """Add the rows by · ∂(end of the segment before − start) of the segments `to`, with residuals r, (J, d) each.

        Residuals of momenta are over the masses; `own` (J, n, P) is minus their derivative through the masses.
        Return the coupling of the start of each segment with the next, (S, d, d).
        """
        upper = torch.zeros_like(self.blocks)
        if not len(to):
            return upper
        P, rows = len(self.corner), self.slopes[to - 1] * by[..., None]
        by_theta, before = rows[..., :P], rows[..., P:]
        if own is not None:
            n = own.shape[1]
            by_theta = torch.cat([by_theta[:, :n], by_theta[:, n : 2 * n] - own, by_theta[:, 2 * n :]], 1)
        self.corner.addmm_(by_theta.flatten(0, 1).T, by_theta.flatten(0, 1))
        self.by_theta.addmv_(by_theta.flatten(0, 1).T, r.flatten())
        self.blocks[to - 1] += before.mT @ before
        self.border[to - 1] += before.mT @ by_theta
        self.by_state[to - 1] += (before.mT @ r[..., None])[..., 0]
        # The derivative by the start of the segment itself is −by.
        self.blocks[to] += torch.diag_embed(by.square())
        self.border[to] -= by[..., None] * by_theta
        self.by_state[to] -= by * r
        upper[to - 1] = -before.mT * by[:, None, :]
        return upper
