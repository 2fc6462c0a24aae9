"""A model with its inputs at one step's value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

from torch import Tensor

from herglotz.mechanics import Partials
from herglotz.models.capabilities import Capabilities


@dataclass(frozen=True)
class DrivenLagrangian:
    """A discrete Lagrangian with the derivatives and forces of a model whose inputs are u."""

    # A `ContactLagrangian` or an `OwnLagrangian`, whose modules import this one.
    model: Any
    u: Tensor  # (..., m)

    @property
    def capabilities(self) -> Capabilities:
        """The capabilities of the model."""
        return self.model.capabilities

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """L_d, shape (...)."""
        return cast(Tensor, self.model(q0, q1, s0, h, 0, self.u))

    def partials(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor | float, order: int = 1) -> Partials:
        """See `herglotz.mechanics.partials`."""
        return self.model.partials(q0, q1, s0, h, order, self.u)

    def partials_increment(self, q0: Tensor, delta: Tensor, s0: Tensor, h: Tensor, order: int = 1) -> Partials:
        """`partials` at (q0, q0 + Δ, s0)."""
        return self.model.partials_increment(q0, delta, s0, h, order, self.u)

    def typical_increment(self, h: Tensor) -> Tensor:
        """See `ContactLagrangian.typical_increment`."""
        return self.model.typical_increment(h)

    def forces(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> tuple[Tensor, Tensor] | None:
        """F⁻ and F⁺, each (..., n); None for a model without forces."""
        return self.model.forces(q0, q1, s0, h, self.u)
