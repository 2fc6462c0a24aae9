"""Polynomials in time through windows of samples, by least squares; windows with the same times share a matrix."""

from __future__ import annotations

import torch
from torch import Tensor

# Of half a window's width: times that differ by less are alike, but for the rounding of t / h.
ROUNDED = 1e-11


def powers(x: Tensor, degree: int) -> Tensor:
    """1, x, x² … of the times of windows, (N, w) → (N, w, degree + 1)."""
    return torch.stack([x**k for k in range(degree + 1)], -1)


def pseudo_inverses(x: Tensor, degree: int) -> Tensor:
    """What turns values at times x (N, w), about 1 in size, into the coefficients of `powers`, (N, degree + 1, w).

    Most windows of even steps have the times of the middle one, and share its matrix; (1, degree + 1, w) if all do.
    """
    middle = x[len(x) // 2]
    others = (x - middle).abs().amax(1) > ROUNDED
    Q, R = torch.linalg.qr(powers(torch.cat([middle[None], x[others]]), degree))
    inverses = torch.linalg.solve_triangular(R, Q.mT, upper=True)
    if len(inverses) == 1:
        return inverses
    every = inverses[:1].repeat(len(x), 1, 1)
    every[others] = inverses[1:]
    return every
