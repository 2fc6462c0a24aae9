"""Friction between joints: the hinge of two links brakes the difference of their speeds."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from herglotz.models.config import ModelConfig
from herglotz.models.jet import pairs
from herglotz.models.term import Term


class CoupledFriction(Term):
    """f_i = −Σ_{j≠i} b_ij v_j with b symmetric, beside the b_ii of `Friction`: F⁻ = c (h/2) f, F⁺ = (h/2) f, v = Δ/h.

    Two links with angles from the vertical and viscous hinges b have b₁₁ = 2b, b₂₂ = b and b₁₂ = −b, which one number a
    coordinate cannot say. The entries are plain parameters that start at 0; b is positive semidefinite where the data
    say so, not by construction.
    """

    def __init__(self, config: ModelConfig):
        super().__init__(config)
        self.viscous = nn.Parameter(torch.zeros(self.dof * (self.dof - 1) // 2, dtype=torch.float64))

    def matrix(self) -> Tensor:
        """Return the matrix b without its diagonal, (n, n)."""
        b = self.viscous
        i, j = pairs(self.dof, b.device)
        off = i != j
        upper = b.new_zeros(self.dof, self.dof).index_put((i[off], j[off]), b)
        return upper + upper.T

    def force(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return f = −b v and −b."""
        b = self.matrix()
        return -v @ b, -b
