"""Terms of a linear model of accelerations, which differences of positions give."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.training.baseline import Differences, differences


def acceleration_terms(data: Trajectories) -> Differences:
    """The terms of `estimate_baseline`, and for each coordinate second harmonics or powers, and its own friction.

    Angles have second harmonics, lengths the powers 2 and 3; friction is viscous and quadratic.
    """
    found = differences(data)
    own = []
    for q, w, angle in zip(found.triples.q1.T, found.v.T, data.angles, strict=True):
        waves = [(2 * q).sin(), (2 * q).cos()] if angle else [q.square(), q**3]
        own.append(torch.stack([*waves, w, w * w.abs()], -1))
    return found._replace(columns=torch.cat([found.columns, for_each(torch.stack(own, 1))], -1))


def for_each(own: Tensor) -> Tensor:
    """Columns (T, n, k) of each coordinate in its own equation, with coefficients of its own, (T, n, n k)."""
    return (torch.eye(own.shape[1]).to(own)[:, :, None] * own[:, None]).flatten(2)
