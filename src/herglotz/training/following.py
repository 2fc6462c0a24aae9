"""Inputs that follow from the state, as those of a controller do: nothing but the rest of them tells what they do."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.smoothing import slopes
from herglotz.least_squares import least_squares

# Share of the spread that separates what follows from what does not.
HALF = 0.5


def constant(u: Tensor) -> Tensor:
    """Which inputs of u (N, m) have the same value at all samples, (m,) bool."""
    return (u == u[0]).all(0)


def unexplained(
    data: Trajectories,
    states: Tensor,  # (N, n) or more columns, q first
) -> float:
    """The part of the inputs that is no linear function of q and q̇, RMS over the spread of each input.

    Constant inputs do not count; infinite if all are constant.
    """
    assert data.u is not None
    q, changing = states[:, : data.dof], ~constant(data.u)
    if not bool(changing.any()):
        return math.inf
    x, u = torch.cat([q, slopes(data, q)], 1), data.u[:, changing].to(q)
    x, u = x - x.mean(0), u - u.mean(0)
    x, u = (y / y.square().mean(0).sqrt().clamp_min(1e-300) for y in (x, u))
    return float((u - x @ least_squares(x.T @ x, x.T @ u)).square().mean().sqrt())
