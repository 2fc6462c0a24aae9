"""Backward elimination: the coefficient whose removal costs the fit least goes, one after the other."""

from __future__ import annotations

import torch
from torch import Tensor

# Eigenvalue of a null direction, relative to the largest: what rounding leaves.
NULL = 1e-13


def prune(
    A: Tensor,  # (P, P) JᵀJ at the fit, residuals over their RMS
    x: Tensor,  # (P,) the fit
    candidates: Tensor,  # (k,) indices of the coefficients that may go
    worth: float,  # (1) twice the cost above which a coefficient stays
    simplest: Tensor | None = None,  # (j,) those candidates that go only where no other candidate can
) -> tuple[Tensor, Tensor]:
    """(kept, x): the candidates that stay, and the parameters at the minimum without the others.

    Leaving out coefficient i costs ½ x_i² / (A⁻¹)_ii in the quadratic model of the fit. The cheapest coefficient goes
    while its cost is less than ½ `worth`, which is log N by the Bayesian information criterion, N being the number of
    residuals (Schwarz 1978); nothing is fitted again. Where two sets of terms make nearly the same force, rounding and
    noise would choose between them; the set with the simplest terms is kept instead (marginality, Nelder 1977).
    """
    keep = torch.ones(len(x), dtype=torch.bool, device=x.device)
    out, x = torch.zeros_like(keep), x.clone()
    out[candidates] = True
    late = torch.zeros_like(keep)
    late[candidates[:0] if simplest is None else simplest] = True
    scale = A.diagonal().clamp_min(1e-300).sqrt()
    S, y = A / scale[:, None] / scale, x * scale
    while bool((out & keep).any()):
        rows = keep.nonzero()[:, 0]
        C = torch.linalg.pinv(S[rows][:, rows], hermitian=True)
        cost = torch.where(out[rows], y[rows].square() / C.diagonal().clamp_min(1e-300), torch.inf)
        early = torch.where(late[rows], torch.inf, cost)
        cost = early if float(early.min()) <= worth else cost
        i = int(cost.argmin())
        if float(cost[i]) > worth:
            break
        y[rows] = y[rows] - C[:, i] / C[i, i] * y[rows[i]]
        y[rows[i]] = 0.0
        keep[rows[i]] = False
    return candidates[keep[candidates]], y / scale


def of_unit_diagonal(A: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices (..., k, k) scaled to a unit diagonal, and the sizes (..., k); rows of 0 stay, with the size 1."""
    diagonal = A.diagonal(dim1=-2, dim2=-1)
    size = torch.where(diagonal > 0, diagonal, 1.0).sqrt()
    return A / size[..., None] / size[..., None, :], size


def inverse_of(A: Tensor) -> Tensor:
    """A⁻¹ of matrices (..., k, k) with possible null directions, where it is very large; a pseudo-inverse would be 0.

    A is scaled to a unit diagonal, so that units do not decide which directions are null.
    """
    scaled, size = of_unit_diagonal(A)
    values, vectors = torch.linalg.eigh(scaled)
    values = values.maximum(NULL * values[..., -1:])
    return (vectors / values[..., None, :]) @ vectors.mT / size[..., None] / size[..., None, :]
