"""The midpoint q̄ and the velocity v of a step, and the features that networks read, computed once for all terms."""

from __future__ import annotations

from torch import Tensor

from herglotz.models.config import ModelConfig
from herglotz.models.jet import Jet, concatenate
from herglotz.models.network import midpoint_velocity_jets, position_features


class Phase:
    """q̄ = (q0 + q1)/2, v = Δ/h and their features as jets over (q0, q1), each made at its first use.

    A model whose terms read none of them pays nothing.
    """

    def __init__(
        self,
        q0: Tensor,  # (..., n)
        q1: Tensor,  # (..., n)
        h: Tensor,  # (...)
        order: int,  # 0, 1 or 2
        sizes: ModelConfig,  # angles, scale and speed of the coordinates
        delta: Tensor | None = None,  # (..., n) q1 − q0 where it is known better than by subtraction
    ):
        self.q0, self.q1, self.h, self.order, self.sizes = q0, q1, h, order, sizes
        self.delta = delta
        self._jets: tuple[Jet, Jet] | None = None
        self._position: Jet | None = None
        self._features: Jet | None = None

    @property
    def move(self) -> Tensor:
        """Δ = q1 − q0, (..., n)."""
        return self.q1 - self.q0 if self.delta is None else self.delta

    @property
    def mean(self) -> Jet:
        """q̄, vector-valued (..., n)."""
        return self._pair()[0]

    @property
    def velocity(self) -> Jet:
        """v, vector-valued (..., n)."""
        return self._pair()[1]

    @property
    def position(self) -> Jet:
        """Features of q̄: (sin, cos) of an angle, q̄ / scale of another coordinate."""
        if self._position is None:
            self._position = position_features(self.mean, self.sizes.angles, self.sizes.scale)
        return self._position

    @property
    def features(self) -> Jet:
        """Features of q̄, then v / speed."""
        if self._features is None:
            v = self.velocity
            v = Jet(v.data / v.data.new_tensor(self.sizes.speed), v.tangents, v.order)
            self._features = concatenate([self.position, v])
        return self._features

    def _pair(self) -> tuple[Jet, Jet]:
        if self._jets is None:
            self._jets = midpoint_velocity_jets(self.q0, self.q1, self.h, self.order, self.delta)
        return self._jets
