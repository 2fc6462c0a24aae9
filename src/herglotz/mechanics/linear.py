"""Batched linear equations without exceptions: a singular matrix gives inf or nan in its own sample."""

from __future__ import annotations

import torch
from torch import Tensor

# Batches of larger matrices are solved one by one: torch 2.13 gives each matrix a thread of its own, in which the LU
# decomposition of oneMKL hangs or fails from 190 rows on.
MAX_BATCHED_ROWS = 128


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """matrix⁻¹ vector without an exception: inf or nan where the matrix is singular; written out for n ≤ 2."""
    n = matrix.shape[-1]
    if n == 1:
        return vector / matrix[..., 0]
    if n == 2:
        return _eliminate(matrix, vector)
    return solve_columns(matrix, vector[..., None])[..., 0]


def solve_columns(matrix: Tensor, columns: Tensor) -> Tensor:
    """matrix⁻¹ columns, (..., n, k), without an exception."""
    n = matrix.shape[-1]
    if n == 1:
        return columns / matrix
    if n <= MAX_BATCHED_ROWS or matrix.ndim == 2 or matrix.device.type != "cpu" or torch.get_num_threads() == 1:
        return torch.linalg.solve_ex(matrix, columns)[0]
    batch = torch.broadcast_shapes(matrix.shape[:-2], columns.shape[:-2])
    pairs = zip(*(x.expand(*batch, *x.shape[-2:]).flatten(0, -3) for x in (matrix, columns)), strict=True)
    return torch.stack([torch.linalg.solve_ex(a, b)[0] for a, b in pairs]).unflatten(0, batch)


def _eliminate(matrix: Tensor, vector: Tensor) -> Tensor:
    """Gaussian elimination with a row exchange, for n = 2."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = vector.unbind(-1)
    swap = c.abs() > a.abs()
    a, c = torch.where(swap, c, a), torch.where(swap, a, c)
    b, d = torch.where(swap, d, b), torch.where(swap, b, d)
    x, y = torch.where(swap, y, x), torch.where(swap, x, y)
    factor = c / a
    y = (y - factor * x) / (d - factor * b)
    return torch.stack([(x - b * y) / a, y], -1)
