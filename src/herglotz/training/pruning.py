"""Selection of features: the one that the fit loses least without is removed, one after the other."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def prune(
    A: Tensor,  # (P, P) JᵀJ at the fit, residuals over their RMS
    x: Tensor,  # (P,) the fit
    candidates: Tensor,  # indices of the coefficients that may be left out
    residuals: int,
) -> tuple[Tensor, Tensor]:
    """(kept, x): the candidates that stay, and the parameters moved to where the others' absence sends them.

    Leaving out coefficient i costs ½ x_i² / (A⁻¹)_ii in the quadratic model of the fit; the one that costs least goes
    while that is less than ½ log N, N the number of residuals: backward elimination by the Bayesian information
    criterion (Schwarz 1978), without fitting again.
    """
    keep = torch.ones(len(x), dtype=torch.bool, device=x.device)
    out, x = torch.zeros_like(keep), x.clone()
    out[candidates] = True
    scale = A.diagonal().clamp_min(1e-300).sqrt()
    S, y = A / scale[:, None] / scale, x * scale
    while bool((out & keep).any()):
        rows = keep.nonzero()[:, 0]
        C = torch.linalg.pinv(S[rows][:, rows], hermitian=True)
        cost = torch.where(out[rows], y[rows].square() / C.diagonal().clamp_min(1e-300), torch.inf)
        i = int(cost.argmin())
        if float(cost[i]) > math.log(residuals):
            break
        y[rows] = y[rows] - C[:, i] / C[i, i] * y[rows[i]]
        y[rows[i]] = 0.0
        keep[rows[i]] = False
    return candidates[keep[candidates]], y / scale
