"""JᵀJ of multiple shooting: a border of parameters around block tridiagonal states of segments.

⎡ C  Bᵀ ⎤     C (P, P): parameters
⎣ B  T  ⎦     T: starts of segments, block tridiagonal; B (S, d, P): starts by parameters
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

# (diagonal (S, d, d), upper (S, d, d), columns (S, d, R)) → T⁻¹ columns, or None if T is not positive definite
Eliminate = Callable[[Tensor, Tensor, Tensor], Tensor | None]


@dataclass(frozen=True)
class Arrowhead:
    """The matrix, solved by eliminating the states (`solvers.levenberg_marquardt.ByProducts`)."""

    corner: Tensor  # (P, P)
    border: Tensor  # (S, d, P)
    blocks: Tensor  # (S, d, d) diagonal of T
    upper: Tensor  # (S, d, d) right of it; 0 behind the last segment of a trajectory
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

    def dense(self) -> Tensor:
        """The matrix as a tensor, (P + S·d, P + S·d)."""
        P, (S, d) = len(self.corner), self.border.shape[:2]
        A = self.corner.new_zeros(P + S * d, P + S * d)
        A[:P, :P] = self.corner
        A[P:, :P] = self.border.flatten(0, 1)
        A[:P, P:] = A[P:, :P].T
        T, k = A[P:, P:].unflatten(0, (S, d)).unflatten(2, (S, d)), torch.arange(S)  # (S, d, S, d)
        T[k, :, k] = self.blocks
        T[k[:-1], :, k[1:]] = self.upper[:-1]
        T[k[1:], :, k[:-1]] = self.upper[:-1].mT
        return A

    def solve(self, b: Tensor, damping: Tensor) -> Tensor | None:
        """(matrix + diag(damping))⁻¹ b by eliminating the states first; None if there is no finite solution."""
        P, (S, d) = len(self.corner), self.border.shape[:2]
        blocks = self.blocks + torch.diag_embed(damping[P:].reshape(S, d))
        solved = self.eliminate(blocks, self.upper, torch.cat([self.border, b[P:].reshape(S, d, 1)], -1))
        if solved is None:
            return None
        taken = self.border.flatten(0, 1).T @ solved.flatten(0, 1)
        reduced = self.corner + torch.diag(damping[:P]) - taken[:, :P]
        factor, info = torch.linalg.cholesky_ex((reduced + reduced.T) / 2)
        if int(info) != 0:
            return None
        top = torch.cholesky_solve((b[:P] - taken[:, P])[:, None], factor)[:, 0]
        step = torch.cat([top, (solved[..., -1] - solved[..., :-1] @ top).flatten()])
        return step if bool(torch.isfinite(step).all()) else None


def dense(A: Tensor | Any) -> Tensor:
    """JᵀJ as a tensor, from a tensor or from an object with `dense`."""
    return A if isinstance(A, Tensor) else A.dense()
