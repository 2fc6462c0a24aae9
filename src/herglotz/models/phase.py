"""The midpoint q̄, the velocity v and the networks' features of a step, computed once for all terms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from herglotz.models.config import ModelConfig
from herglotz.models.jet import Jet, concatenate
from herglotz.models.network import midpoint_velocity_jets, position_features


@dataclass(eq=False)
class Phase:
    """q̄ = (q0 + q1)/2, v = Δ/h and their features as jets over (q0, q1), each computed at its first use.

    `order` is that of the jets, 0, 1 or 2; `sizes` has the angles, scale and speed of the coordinates.
    """

    q0: Tensor  # (..., n)
    q1: Tensor  # (..., n)
    h: Tensor  # (...)
    order: int
    sizes: ModelConfig
    delta: Tensor | None = None  # (..., n) q1 − q0 without the rounding of the subtraction

    @property
    def move(self) -> Tensor:
        """Δ = q1 − q0, (..., n)."""
        return self.q1 - self.q0 if self.delta is None else self.delta

    @property
    def mean(self) -> Jet:
        """q̄, vector-valued (..., n)."""
        return self._pair[0]

    @property
    def velocity(self) -> Jet:
        """v, vector-valued (..., n)."""
        return self._pair[1]

    @cached_property
    def position(self) -> Jet:
        """Features of q̄: (sin, cos) of an angle, q̄ / scale of another coordinate."""
        return position_features(self.mean, self.sizes.angles, self.sizes.scale)

    @cached_property
    def features(self) -> Jet:
        """Features of q̄, then v / speed."""
        v = self.velocity
        v = Jet(v.data / v.data.new_tensor(self.sizes.speed), v.tangents, v.order)
        return concatenate([self.position, v])

    @cached_property
    def _pair(self) -> tuple[Jet, Jet]:
        return midpoint_velocity_jets(self.q0, self.q1, self.h, self.order, self.delta)
