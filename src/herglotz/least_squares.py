"""Linear least squares whose result is the same to the last bit in every call."""

from __future__ import annotations

import torch
from torch import Tensor


def least_squares(A: Tensor, b: Tensor) -> Tensor:
    """Return the x of least norm among the minimisers of |A x − b|; A (..., m, k), b (..., m, r), x (..., k, r).

    torch's default on a CPU, LAPACK's gelsy, reads initial column pivots from uninitialised memory, on which the last
    bits of x depend. gelsd, by the singular value decomposition, has no pivots. On a GPU torch offers gels alone, and A
    must have full rank.
    """
    return torch.linalg.lstsq(A, b, driver="gels" if A.is_cuda else "gelsd").solution
