"""Linear least squares with the same bits every time."""

from __future__ import annotations

import torch
from torch import Tensor


def least_squares(A: Tensor, b: Tensor) -> Tensor:
    """Return x of least |A x − b|, and of those the shortest; A (..., m, k), b (..., m, r), x (..., k, r).

    torch's default on a processor, LAPACK's gelsy, starts from column pivots that are whatever memory held: columns
    that they name go first, and the last bits of x depend on it. The singular value decomposition has no pivots. On a
    GPU torch has no other solver than gels, and A must have full rank.
    """
    return torch.linalg.lstsq(A, b, driver="gels" if A.is_cuda else "gelsd").solution
