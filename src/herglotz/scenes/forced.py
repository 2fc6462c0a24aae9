"""A force beside the Lagrangian's own: what no L(q, v, s) of one action s says, such as friction of one joint.

The continuous motion is Lagrange–d'Alembert–Herglotz, ṗ = L_q + L_s p + f(q, v). It is no contact flow, so such a scene
has no exact discrete Lagrangian; its rules are discrete Lagrangians with discrete forces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian
from herglotz.scenes.special import as_step

External = Callable[[Tensor, Tensor], Tensor]  # (q, v), (..., n) each → f, (..., n)


@dataclass(frozen=True)
class ForcedRule:
    """A rule for L with the forces of the midpoint, F⁻ = F⁺ = (h/2) f((q0 + q1)/2, (q1 − q0)/h): of order 2 at c = 1.

    Source: trap 4 of `docs/mathematics.md`, discrete forces.
    """

    rule: DiscreteLagrangian
    external: External

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L_d, shape (...)."""
        return self.rule(q0, q1, s0, h)

    def forces(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        """F⁻ and F⁺, (..., n) each."""
        step = as_step(h, q0)[..., None]
        half = 0.5 * step * self.external(0.5 * (q0 + q1), (q1 - q0) / step)
        return half, half
