"""Friction between joints: the hinge of two links brakes the difference of their speeds."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from herglotz.mechanics import Forces
from herglotz.models.jet import pairs


class CoupledFriction(nn.Module):
    """f_i = −Σ_{j≠i} b_ij v_j with b symmetric, beside the b_ii of `Friction`: F⁻ = c (h/2) f, F⁺ = (h/2) f, v = Δ/h.

    Two links with angles from the vertical and viscous hinges b have b₁₁ = 2b, b₂₂ = b and b₁₂ = −b, which one number a
    coordinate cannot say. The entries are plain parameters that start at 0; b is positive semidefinite where the data
    say so, not by construction.
    """

    def __init__(self, dof: int):
        super().__init__()
        self.dof = dof
        self.viscous = nn.Parameter(torch.zeros(dof * (dof - 1) // 2, dtype=torch.float64))

    def matrix(self) -> Tensor:
        """Return the matrix b without its diagonal, (n, n)."""
        b = self.viscous
        i, j = pairs(self.dof, b.device)
        off = i != j
        upper = b.new_zeros(self.dof, self.dof).index_put((i[off], j[off]), b)
        return upper + upper.T

    def forward(self, v: Tensor, c: Tensor, h: Tensor, own: Forces) -> Forces:
        """Return `own` plus these forces at the velocity v (..., n), with derivatives if `own` has them."""
        b = self.matrix()
        f = -v @ b
        minus, plus = own.minus + (c * h / 2)[..., None] * f, own.plus + (h / 2)[..., None] * f
        if own.minus_2 is None:
            return Forces(minus, plus)
        assert own.minus_1 is not None
        assert own.plus_1 is not None
        assert own.plus_2 is not None
        before, after = (c / 2)[..., None, None] * b, b / 2
        return Forces(
            minus, plus, own.minus_1 + before, own.minus_2 - before, own.minus_3,
            own.plus_1 + after, own.plus_2 - after, own.plus_3,
        )  # fmt: skip
