"""JᵀJ of parameters and the states of whole trajectories: a border of parameters around block tridiagonal states.

    ⎡ C  Bᵀ ⎤     C (P, P): parameters
    ⎣ B  T  ⎦     T: states, block tridiagonal; B (…, P): states by parameters

is solved by eliminating the states, (C − Bᵀ T⁻¹ B) δθ = b_θ − Bᵀ T⁻¹ b_x, at a cost linear in the number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.stepping.block_tridiagonal import Blocks, eliminate, multiply
from herglotz.training.distributed import everywhere, of_first


@dataclass(frozen=True)
class Bordered:
    """The matrix, for S trajectories of M states of d numbers (`solvers.levenberg_marquardt.ByProducts`)."""

    corner: Tensor  # (P, P)
    border: Tensor  # (S, M, d, P)
    blocks: Blocks  # (S, M, d, d) each

    def __matmul__(self, v: Tensor) -> Tensor:
        """The matrix times v, (P + S·M·d,)."""
        P = len(self.corner)
        a, x = v[:P], v[P:].reshape(self.border.shape[:3])
        top = self.corner @ a + torch.einsum("smdp,smd->p", self.border, x)
        return torch.cat([top, (self.border @ a + multiply(self.blocks, x)).flatten()])

    def diagonal(self) -> Tensor:
        """Its diagonal."""
        return torch.cat([self.corner.diagonal(), self.blocks[0].diagonal(dim1=-2, dim2=-1).flatten()])

    def solve(self, b: Tensor, damping: Tensor) -> Tensor | None:
        """(matrix + diag(damping))⁻¹ b, or None if there is no finite solution."""
        P, shape = len(self.corner), self.border.shape
        diagonal, *beside = (x.double() for x in self.blocks)
        corner = self.corner.double() + torch.diag(damping[:P].double())
        diagonal = diagonal + torch.diag_embed(damping[P:].double().reshape(shape[:3]))
        border = self.border.double()
        columns = torch.cat([border, b[P:].double().reshape(*shape[:3], 1)], -1)
        solved = eliminate((diagonal, beside[0], beside[1]), columns)
        by_border, by_b = solved[..., :P], solved[..., P:]
        reduced = corner - torch.einsum("smdp,smdr->pr", border, by_border)
        factor, info = torch.linalg.cholesky_ex((reduced + reduced.T) / 2)
        right = b[:P, None].double() - torch.einsum("smdp,smdr->pr", border, by_b)
        top = torch.cholesky_solve(right, factor)
        y = torch.cat([top, (by_b - by_border @ top).flatten(0, 2)]).to(b.dtype)[:, 0]
        solved_here = int(info) == 0 and bool(torch.isfinite(y).all())
        return of_first(y)[0] if everywhere(solved_here) else None
