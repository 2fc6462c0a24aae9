"""V(q) and V′(q) of an explicit step by a forward and a reverse sweep, at a third of the cost of a jet.

The jets of `herglotz.models` carry every derivative forward; a test compares `FieldOf` with them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.models.sweep import Sweep, numbers, trigonometry
from herglotz.models.term import value_and_slope
from herglotz.models.terms import Potential


class Field(NamedTuple):
    """The potential at a position."""

    V: Tensor  # (...)
    slope: Tensor  # (..., n) V′(q)


class FieldOf:
    """V and V′ of a potential at its present parameters, by plain torch operations that autograd differentiates."""

    def __init__(self, potential: Potential):
        self.stiffness, self.tilt = potential.stiffness, potential.tilt
        self.angles, self.all_angles = potential.angles, all(potential.angles)
        network, self.across = potential.network, potential.across
        self.features, self.more = potential.features, potential.more
        self.sweep = None
        if network is not None:
            self.sweep = Sweep(network, potential.angles, potential.scale, None, potential.energy)

    def __call__(self, q: Tensor) -> Field:
        """At q, (..., n)."""
        # Springs and network see q only across the translations.
        V, slope = self._own(q if self.across is None else q @ self.across)
        slope = slope if self.across is None else slope @ self.across
        if self.features is not None:
            more, bend = self.features.value_and_slope(q)
            V, slope = V + more, slope + bend
        if self.more:
            more, bend = value_and_slope(self.more, q)
            V, slope = V + more, slope + bend
        return Field(V, slope)

    def _own(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Springs and network."""
        k, b = self.stiffness, self.tilt
        x = trigonometry(q, self.angles)
        # 1 − cos q of an angle, q²/2 of a length.
        rise = numbers(q.dtype, q.device)[1] - x.c
        if not self.all_angles:
            rise = torch.where(torch.tensor(self.angles, device=q.device), rise, q * q / 2)
        V = rise @ k + x.s @ b
        slope = torch.addcmul(x.s * k, x.ds, b)
        if self.sweep is None:
            return V, slope
        value, g, _ = self.sweep(torch.cat([x.s, x.c], -1))
        n = q.shape[-1]
        return V + value, torch.addcmul(torch.addcmul(slope, g[..., :n], x.ds), g[..., n:], x.minus_sin)
