"""`left_by_the_past`: how much of a force the past of a motion explains that its present state does not.

The force y is predicted for blocks of time from the other blocks, by two kernel ridge regressions:

* from the state x = (q, q̇, u) alone, with k(x, x′) = exp(−|x − x′|²/2ℓ²);
* from the state and the past z, with k(x, x′) (1 + z·z′/m): sums of functions of x, and of such functions times z_j;
* from the state and the time since the start of the recording, in the same way with z = (t, t²).

A force of the state that a model lacks is predicted by the state as well. The past of a motion has m signals of each
coordinate: q̇, q̇² and q² through low-pass filters, as springs behind dampers, heat and the action remember them, and
the position that a play has lost, as hysteresis remembers it. Time predicts what grows, leaks or wears.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.smoothing import slopes

# Widths ℓ of the kernel, in standard deviations of x, and ridges: those that predict best are taken.
WIDTHS, RIDGES = (0.5, 1.0, 2.0, 4.0), (1e-3, 1e-2, 1e-1, 1.0)
# Time constants of the filters, in periods 2π σ(q)/σ(q̇) of the motion, and half widths of the play, in σ(q).
FILTERS, PLAYS = (1 / 8, 1 / 2, 2.0), (0.1, 0.3, 1.0)
# Blocks of time that are predicted together, and blocks in all.
FOLDS, PIECES = 8, 16
# Most samples: an inverse takes about 5 ms.
MOST = 400


def left_by_the_past(
    data: Trajectories,
    y: Tensor,  # (K, n) force at some samples
    x: Tensor,  # (K, m) state there
    at: Tensor,  # (K,) rows of these samples
) -> tuple[float, float, float]:
    """Mean squares that remain, over the variance of y, of predictions from the state, alone, with past, with time."""
    some = slice(None, None, -(-len(y) // MOST))
    since = data.t - data.t[list(data.offsets)][data.trajectory]
    time = torch.stack([since, since.square()], 1)
    y, x, z, time = (_standard(part) for part in (y[some], x[some], signals(data)[at[some]], time[at[some]]))
    apart = torch.cdist(x, x).square()
    kernels = [torch.exp(-apart / (2 * width**2)) for width in WIDTHS]
    others = (torch.ones_like(apart), *(1 + x @ x.T / x.shape[1] for x in (z, time)))
    of_state, of_past, of_time = (min(_remains(k * other, y) for k in kernels) for other in others)
    return of_state, of_past, of_time


def signals(data: Trajectories) -> Tensor:
    """The signals of the past at every sample, (N, m); each recording begins without a past."""
    speeds = slopes(data, data.q)
    spread = data.q.std(0, correction=0)
    period = 2 * math.pi * float((spread / speeds.std(0, correction=0).clamp_min(1e-300)).max())
    into = torch.cat([speeds, speeds.square(), data.q.square()], 1)
    constants = period * into.new_tensor(FILTERS)[:, None]
    widths = into.new_tensor(PLAYS)[:, None] * spread
    first, found = set(data.offsets), []
    for k in range(data.samples):
        if k in first:
            low, held = into.new_zeros(len(FILTERS), into.shape[1]), data.q[k].expand_as(widths)
        else:
            low = into[k] + (low - into[k]) * torch.exp(-(data.t[k] - data.t[k - 1]) / constants)
            held = held.clamp(data.q[k] - widths, data.q[k] + widths)
        found.append(torch.cat([low.flatten(), (data.q[k] - held).flatten()]))
    return torch.stack(found)


def _remains(kernel: Tensor, y: Tensor) -> float:
    """Mean square of the errors of predictions of left-out blocks, with the best ridge; y has variance 1."""
    blocks = torch.arange(len(y), device=y.device).tensor_split(PIECES)
    folds = [torch.cat(blocks[k::FOLDS]) for k in range(FOLDS)]
    found = []
    for ridge in RIDGES:
        inverse = torch.linalg.inv(kernel + ridge * torch.eye(len(y)).to(kernel))
        weights = inverse @ y
        errors = [torch.linalg.solve(inverse[fold][:, fold], weights[fold]) for fold in folds]
        found.append(float(torch.cat(errors).square().mean()))
    return min(found)


def _standard(x: Tensor) -> Tensor:
    """Columns of mean 0 and variance 1; constant columns become 0."""
    return (x - x.mean(0)) / x.std(0, correction=0).clamp_min(1e-300)
