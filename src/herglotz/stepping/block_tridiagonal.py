"""Block tridiagonal systems, batched: elimination in order, and a dense solve for samples where elimination fails."""

from __future__ import annotations

import torch
from torch import Tensor

# Diagonal, upper and lower blocks, (..., K, m, m) each. The last upper and the first lower block are not used.
Blocks = tuple[Tensor, Tensor, Tensor]


def solve_blocks(blocks: Blocks, rhs: Tensor) -> Tensor:
    """Solve the system for rhs (..., K, m).

    Elimination takes pivots inside blocks only and fails where a leading part is singular though the matrix is not (a
    caustic that the curve crosses exactly at a node): such samples are solved densely. The result is not finite where
    the matrix is singular.
    """
    u = eliminate(blocks, rhs[..., None])[..., 0]
    defect = (multiply(blocks, u) - rhs).abs().flatten(-2).amax(-1)
    bad = ~(defect <= 1e-3 * torch.finfo(rhs.dtype).eps ** 0.25 * rhs.abs().flatten(-2).amax(-1))
    if bool(bad.any()):
        diagonal, upper, lower = (x[bad] for x in blocks)
        matrix = _assemble((diagonal, upper, lower))
        fixed = torch.linalg.solve_ex(matrix, rhs[bad].flatten(-2)[..., None])[0][..., 0]
        u = u.clone()
        u[bad] = fixed.unflatten(-1, rhs.shape[-2:])
    return u


def eliminate(blocks: Blocks, rhs: Tensor) -> Tensor:
    """Solve for columns rhs (..., K, m, R), pivots inside blocks only: for positive definite systems."""
    diagonal, upper, lower = blocks
    count, m = rhs.shape[-3:-1]
    reduced: list[Tensor] = []
    pivot, column = diagonal[..., 0, :, :], rhs[..., 0, :, :]
    for k in range(count):
        reduced.append(torch.linalg.solve_ex(pivot, torch.cat([upper[..., k, :, :], column], -1))[0])
        if k + 1 < count:
            removed = lower[..., k + 1, :, :] @ reduced[-1]
            pivot = diagonal[..., k + 1, :, :] - removed[..., :m]
            column = rhs[..., k + 1, :, :] - removed[..., m:]
    u = [reduced[-1][..., m:]]
    for X in reversed(reduced[:-1]):
        u.append(X[..., m:] - X[..., :m] @ u[-1])
    return torch.stack(u[::-1], -3)


def diagonal_of_inverse(blocks: Blocks) -> Tensor:
    """Diagonal of the inverse, (S, K, m), by elimination from both ends: (A⁻¹)_kk = (S_k + T_k − D_k)⁻¹."""
    diagonal, upper, lower = (x.unbind(1) for x in blocks)
    count = len(diagonal)
    S, T = [diagonal[0]], [diagonal[-1]]
    for k in range(1, count):
        S.append(diagonal[k] - lower[k] @ torch.linalg.solve(S[-1], upper[k - 1]))
        j = count - 1 - k
        T.append(diagonal[j] - upper[j] @ torch.linalg.solve(T[-1], lower[j + 1]))
    both = torch.stack(S, 1) + torch.stack(T[::-1], 1) - blocks[0]
    return torch.linalg.inv(both).diagonal(dim1=-2, dim2=-1)


def multiply(blocks: Blocks, u: Tensor) -> Tensor:
    """The matrix times u (..., K, m)."""
    diagonal, upper, lower = blocks
    zero = torch.zeros_like(u[..., :1, :])
    after, before = torch.cat([u[..., 1:, :], zero], -2), torch.cat([zero, u[..., :-1, :]], -2)
    return sum((a @ x[..., None])[..., 0] for a, x in ((diagonal, u), (upper, after), (lower, before)))  # type: ignore[return-value]


def _assemble(blocks: Blocks) -> Tensor:
    """The dense matrix (..., K m, K m)."""
    diagonal, upper, lower = blocks
    count, m = diagonal.shape[-3:-1]
    matrix = diagonal.new_zeros(*diagonal.shape[:-3], count, m, count, m)
    for k in range(count):
        matrix[..., k, :, k, :] = diagonal[..., k, :, :]
        if k + 1 < count:
            matrix[..., k, :, k + 1, :] = upper[..., k, :, :]
            matrix[..., k + 1, :, k, :] = lower[..., k + 1, :, :]
    return matrix.flatten(-2).flatten(-3, -2)
