"""What stepping, fitting and export ask of a model: its terms, and the model with its inputs at one value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

from torch import Tensor

from herglotz.mechanics import Partials


@dataclass(frozen=True)
class Capabilities:
    """The terms of a model, and properties of a step that follow from the terms.

    A new term is a field here. Every other room reads the properties below, never a field.

    Parameters
    ----------
    order
        Order of the rule: 2, or 4 with the correction of `herglotz.models.order4`.
    baseline
        A kinetic term and a potential; without a baseline the correction is all of L_d but the damping.
    constant_mass
        K = Δᵀ m Δ / 2h with a constant matrix m.
    constant_c
        c depends on h alone: no damping, or a constant rate γ.
    known_damping
        The damping, if any, is a constant rate γ or the affine level's g(q̄, v).
    correction
        A network N of (q̄, v).
    action_flow
        The map of s is nonlinear, as at the full level.
    nonlinear_force
        Dry friction, or another force that is not linear in v.
    sticking
        Dry friction is set-valued.
    coupling
        A force that depends on the velocities of other joints, or on the position.
    """

    order: int
    baseline: bool
    constant_mass: bool
    constant_c: bool
    known_damping: bool
    correction: bool
    action_flow: bool
    nonlinear_force: bool
    sticking: bool
    coupling: bool

    @property
    def carries_s(self) -> bool:
        """Whether the positions depend on s, as at the affine and full levels."""
        return not self.constant_c

    @property
    def linear_in_q1(self) -> bool:
        """Whether the step equation, forces included, is linear in q1, so that a single Newton step solves it."""
        linear = not (self.correction or self.nonlinear_force)
        return self.order == 2 and self.constant_c and self.constant_mass and linear

    @property
    def by_terms(self) -> bool:
        """Whether `herglotz.stepping.equation` evaluates the step term by term; otherwise jets evaluate L_d."""
        whole = self.baseline and self.constant_mass and self.known_damping and self.order == 2
        return whole and not (self.action_flow or self.coupling or self.sticking)

    @property
    def explicit(self) -> bool:
        """Whether the step has a closed form (`herglotz.stepping.explicit`): no iteration."""
        return self.linear_in_q1 and self.by_terms


def capabilities(L_d: object) -> Capabilities | None:
    """The capabilities of a model L_d; None for any other discrete Lagrangian, whose terms are not known."""
    found = getattr(L_d, "capabilities", None)
    return found if isinstance(found, Capabilities) else None


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
