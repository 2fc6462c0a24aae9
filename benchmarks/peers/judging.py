"""What a data set is, and how a trained model is judged on it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from .rollouts import Predictor
from .samples import Samples

LOST = 50.0  # an error beyond which a rollout counts as failed, in units of q
Metrics = dict[str, Any]


@dataclass(frozen=True)
class Problem:
    """One data set.

    Parameters
    ----------
    title
        What it is and what is measured.
    samples
        (seed, exact) → what a peer is given.
    judge
        (predictor, exact) → `rms`, `median`, `failures`, `rollouts`, `decay`, and what else there is.
    simulated
        Whether exact velocities exist.
    relative
        Whether the second coordinate of a double pendulum is the angle between its arms.
    dof
        Number of coordinates.
    whole
        The recording as herglotz reads it, where ours is judged by the free run from its own fitted states.
    """

    title: str
    samples: Callable[[int, bool], Samples]
    judge: Callable[[Predictor, bool], Metrics]
    simulated: bool = True
    relative: bool = False
    dof: int = 1
    whole: Callable[[], Any] | None = None


def errors(found: Tensor, truth: Tensor, energy: Callable[[Tensor], Tensor] | None) -> Metrics:
    """RMS over the rollouts that end, median over all, and the error of the energy relative to its start.

    Parameters
    ----------
    found, truth
        (B, K, n); the first two positions are given, not predicted.
    energy
        Positions (B, K, n) → (B, K−2), by central differences: the same function for both.
    """
    e = (found - truth)[:, 2:]
    size = e.abs().flatten(1).amax(1)
    good = torch.isfinite(size) & (size < LOST)
    out: Metrics = {"rollouts": len(e), "failures": int((~good).sum()), "rms": None, "median": None, "decay": None}
    if bool(good.any()):
        out["rms"] = float(e[good].square().mean().sqrt())
        median = float(torch.where(good[:, None, None], e.abs(), torch.inf).median())
        out["median"] = median if math.isfinite(median) else None
        if energy is not None:
            E = energy(truth)
            out["decay"] = float(((energy(found)[good] - E[good]) / E[:, 0].mean()).square().mean().sqrt())
    return out


def free_run(out: Tensor, truth: Tensor) -> Metrics:
    """Errors of one free run; `decay` is the relative error of the amplitude over its last third."""
    found = errors(torch.cat([truth[:2], out])[None], torch.cat([truth[:2], truth])[None], None)
    last = len(truth) // 3
    if found["failures"] == 0:
        found["decay"] = abs(float(out[-last:].std() / truth[-last:].std()) - 1)
    return found
