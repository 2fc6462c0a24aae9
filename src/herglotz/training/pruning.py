"""Selection of features: the one the fit loses least without is removed, one after the other."""

from __future__ import annotations

import torch
from torch import Tensor

NULL = 1e-13  # eigenvalue, relative to the largest, that rounding leaves of a null direction


def prune(
    A: Tensor,  # (P, P) JᵀJ at the fit, residuals over their RMS
    x: Tensor,  # (P,) the fit
    candidates: Tensor,  # indices of the coefficients that may be left out
    worth: float,  # twice the cost above which a coefficient stays; log N by the Bayesian information criterion
    least: int = 0,  # how many stay whatever they cost
    simplest: Tensor | None = None,  # those of them that go only where no other one can
) -> tuple[Tensor, Tensor]:
    """(kept, x): the candidates that stay, and the parameters moved to where the others' absence sends them.

    Leaving out coefficient i costs ½ x_i² / (A⁻¹)_ii in the quadratic model of the fit; the one that costs least goes
    while that is less than ½ `worth`: backward elimination without fitting again (Schwarz 1978 for log N, N the number
    of residuals). Where two sets of terms make nearly the same force, rounding and noise would choose; the set with
    the simplest terms is kept instead (marginality, Nelder 1977).
    """
    keep = torch.ones(len(x), dtype=torch.bool, device=x.device)
    out, x = torch.zeros_like(keep), x.clone()
    out[candidates] = True
    late = torch.zeros_like(keep)
    late[candidates[:0] if simplest is None else simplest] = True
    scale = A.diagonal().clamp_min(1e-300).sqrt()
    S, y = A / scale[:, None] / scale, x * scale
    while int((out & keep).sum()) > least:
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


def inverse_of(A: Tensor) -> Tensor:
    """A⁻¹ of a matrix that may have null directions: very large along them, where a pseudo-inverse would have 0.

    Scaled to a unit diagonal, so that no unit decides what is a null direction.
    """
    size = torch.where(A.diagonal() > 0, A.diagonal(), 1.0).sqrt()
    values, vectors = torch.linalg.eigh(A / size[:, None] / size)
    return (vectors / values.clamp_min(NULL * float(values[-1]))) @ vectors.T / size[:, None] / size
