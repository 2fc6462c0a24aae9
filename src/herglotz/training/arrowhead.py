"""JᵀJ of parameters and the states of trajectories: a border of parameters around block tridiagonal states.

⎡ C  Bᵀ ⎤     C (P, P): parameters
⎣ B  T  ⎦     T: states, block tridiagonal; B (S, d, P): states by parameters

The S states are those at the starts of all segments (`problems.shooting`), or at all nodes (`problems.smoothing`).
Eliminating the states, (C − Bᵀ T⁻¹ B) δθ = b_θ − Bᵀ T⁻¹ b_x, takes a time that grows with S, not with its cube.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.stepping.block_tridiagonal import Blocks, eliminate
from herglotz.training.distributed import everywhere, of_first
from herglotz.training.problems.grid import SegmentGrid
from herglotz.training.pruning import NULL, inverse_of

# (diagonal (S, d, d), upper (S, d, d), columns (S, d, R)) → T⁻¹ columns, or None if T is not positive definite
Eliminate = Callable[[Tensor, Tensor, Tensor], Tensor | None]


@dataclass(frozen=True)
class Arrowhead:
    """The matrix, solved by eliminating the states."""

    corner: Tensor  # (P, P)
    border: Tensor  # (S, d, P)
    blocks: Tensor  # (S, d, d) diagonal of T
    upper: Tensor  # (S, d, d) right of it; 0 behind the last state of a trajectory
    eliminate: Eliminate

    def __matmul__(self, v: Tensor) -> Tensor:
        """The matrix times v, (P + S·d,)."""
        P = len(self.corner)
        a, x = v[:P], v[P:].reshape(self.border.shape[:2])
        top = self.corner @ a + torch.einsum("sdp,sd->p", self.border, x)
        rest = self.border @ a + (self.blocks @ x[..., None])[..., 0]
        rest[:-1] += (self.upper[:-1] @ x[1:, :, None])[..., 0]
        rest[1:] += (self.upper[:-1].mT @ x[:-1, :, None])[..., 0]
        return torch.cat([top, rest.flatten()])

    def diagonal(self) -> Tensor:
        """Its diagonal."""
        return torch.cat([self.corner.diagonal(), self.blocks.diagonal(dim1=-2, dim2=-1).flatten()])

    def solve(self, b: Tensor, damping: Tensor) -> Tensor | None:
        """(matrix + diag(damping))⁻¹ b; None if some process finds no finite solution."""
        step = self.solved(b.double(), damping.double())
        return of_first(step.to(b))[0] if everywhere(step is not None) and step is not None else None

    def solved(self, b: Tensor, damping: Tensor) -> Tensor | None:
        """(matrix + diag(damping))⁻¹ b by eliminating the states first, in float64; None if that is not finite."""
        P, (S, d) = len(self.corner), self.border.shape[:2]
        if (found := self._reduced(b[P:].reshape(S, d, 1), damping)) is None:
            return None
        reduced, solved, taken = found
        factor, info = torch.linalg.cholesky_ex(reduced)
        if int(info) != 0:
            return None
        top = torch.cholesky_solve((b[:P] - taken[:, 0])[:, None], factor)[:, 0]
        step = torch.cat([top, (solved[..., -1] - solved[..., :-1] @ top).flatten()])
        return step if bool(torch.isfinite(step).all()) else None

    def _reduced(self, columns: Tensor, damping: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
        """The matrices C − Bᵀ T⁻¹ B, T⁻¹ (B, columns) and Bᵀ T⁻¹ columns, damped; None if T is not positive."""
        P, (S, d), border = len(self.corner), self.border.shape[:2], self.border.double()
        blocks = self.blocks.double() + torch.diag_embed(damping[P:].reshape(S, d))
        if (solved := self.eliminate(blocks, self.upper.double(), torch.cat([border, columns], -1))) is None:
            return None
        taken = border.flatten(0, 1).T @ solved.flatten(0, 1)
        reduced = self.corner.double() + torch.diag(damping[:P]) - taken[:, :P]
        return (reduced + reduced.T) / 2, solved, taken[:, P:]

    def covariance(self) -> Tensor | None:
        """The corner of the inverse, (P, P): the covariance of parameters; None if the matrix is not finite.

        What no residual determines has a very large variance (`inverse_of`).
        """
        found = self._information(torch.zeros_like(self.diagonal(), dtype=torch.float64))
        return None if found is None else inverse_of(found)

    def _information(self, damping: Tensor) -> Tensor | None:
        """The Schur complement C − Bᵀ T⁻¹ B of the parameters, damped, (P, P); None if that is not finite."""
        found = self._reduced(damping.new_zeros(*self.border.shape[:2], 0), damping)
        return None if found is None or not bool(torch.isfinite(found[0]).all()) else found[0]

    def onto(self, segments: Sequence[int]) -> Tensor | None:
        """The Schur complement (P + k·d, P + k·d) on the parameters and the states of k segments, in float64.

        It is what is left of the matrix when all other states are eliminated; None if that is not finite.
        """
        P, (S, d), k = len(self.corner), self.border.shape[:2], len(segments)
        border, blocks, upper = (x.double().clone() for x in (self.border, self.blocks, self.upper))
        corner = self.corner.new_zeros(P + k * d, P + k * d, dtype=torch.float64)
        corner[:P, :P] = self.corner
        border = torch.cat([border, border.new_zeros(S, d, k * d)], -1)
        for j, segment in enumerate(segments):
            own = slice(P + j * d, P + (j + 1) * d)
            corner[own, own], corner[own, : own.start] = blocks[segment], border[segment, :, : own.start]
            corner[: own.start, own] = corner[own, : own.start].T
            if segment:
                border[segment - 1, :, own], upper[segment - 1] = upper[segment - 1], 0.0
            if segment + 1 < S:
                border[segment + 1, :, own] = upper[segment].mT
            border[segment], upper[segment], blocks[segment] = 0.0, 0.0, torch.eye(d).to(blocks)
        rest = Arrowhead(corner, border, blocks, upper, self.eliminate)
        damping = corner.new_zeros(len(corner) + S * d)
        damping[len(corner) :] = NULL * rest.diagonal()[len(corner) :] + torch.finfo(corner.dtype).tiny ** 0.5
        return rest._information(damping)

    def without(self, J: Tensor, r: Tensor, segment: Tensor) -> tuple[Arrowhead, Tensor]:
        """The matrix without the rows J (N, n, P + d) of some samples, and Jᵀr of these, in float64.

        `segment` (N,) are the segments of the samples, in order.
        """
        P, (S, d) = len(self.corner), self.border.shape[:2]
        own = Sums.zeros(P, S, d, J.double())
        own.add_rows(J.double(), r.double(), segment)
        left = (self.corner - own.corner, self.border - own.border, self.blocks - own.blocks, self.upper.double())
        return Arrowhead(*left, self.eliminate), torch.cat([own.by_theta, own.by_state.flatten()])


def eliminated(diagonal: Tensor, upper: Tensor, columns: Tensor) -> Tensor | None:
    """T⁻¹ columns, (..., K, d, R), of each of several chains of K states; None if the result is not finite."""
    x = eliminate(tridiagonal(diagonal, upper), columns)
    return x if bool(torch.isfinite(x).all()) else None


def tridiagonal(diagonal: Tensor, upper: Tensor) -> Blocks:
    """The blocks of the symmetric matrix T of chains of K states, (..., K, d, d) each."""
    return diagonal, upper, torch.cat([torch.zeros_like(upper[..., :1, :, :]), upper[..., :-1, :, :].mT], -3)


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
        self.add_rows(Z.flatten(0, 1)[grid.node][:, : r.shape[1]] * by[..., None], r, grid.segment)
        self.slopes.copy_(Z[torch.arange(grid.segments, device=Z.device), grid.end])

    def add_rows(self, rows: Tensor, r: Tensor, segment: Tensor) -> None:
        """Add the rows (N, n, P + d) of samples with residuals r (N, n), in the order of their segments (N,)."""
        P = len(self.corner)
        there, counts = torch.unique_consecutive(segment, return_counts=True)
        parts = zip(there.tolist(), rows.split(counts.tolist()), r.split(counts.tolist()), strict=True)
        for k, own, right in parts:
            by_theta, by_state = own.flatten(0, 1)[:, :P], own.flatten(0, 1)[:, P:]
            self.corner.addmm_(by_theta.T, by_theta)
            self.by_theta.addmv_(by_theta.T, right.flatten())
            self.border[k] += by_state.T @ by_theta
            self.blocks[k] += by_state.T @ by_state
            self.by_state[k] += by_state.T @ right.flatten()

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
