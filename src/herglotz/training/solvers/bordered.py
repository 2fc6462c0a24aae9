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
        y = self.solve_many(b[:, None], damping)
        finite = y is not None and bool(torch.isfinite(y).all())
        return of_first(y[:, 0])[0] if everywhere(finite) and y is not None else None

    def solve_many(self, b: Tensor, damping: Tensor | None = None) -> Tensor | None:
        """`solve` for columns b (P + S·M·d, R); None if the reduced matrix is not positive definite."""
        P, shape = len(self.corner), self.border.shape
        corner, (diagonal, *beside) = self.corner.double(), (x.double() for x in self.blocks)
        if damping is not None:
            corner = corner + torch.diag(damping[:P].double())
            diagonal = diagonal + torch.diag_embed(damping[P:].double().reshape(shape[:3]))
        border = self.border.double()
        columns = torch.cat([border, b[P:].double().reshape(*shape[:3], -1)], -1)
        solved = eliminate((diagonal, beside[0], beside[1]), columns)
        by_border, by_b = solved[..., :P], solved[..., P:]
        reduced = corner - torch.einsum("smdp,smdr->pr", border, by_border)
        factor, info = torch.linalg.cholesky_ex((reduced + reduced.T) / 2)
        if int(info) != 0:
            return None
        top = torch.cholesky_solve(b[:P].double() - torch.einsum("smdp,smdr->pr", border, by_b), factor)
        return torch.cat([top, (by_b - by_border @ top).flatten(0, 2)]).to(b.dtype)
