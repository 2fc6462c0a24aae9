"""The terms of a model, from which stepping, fitting and export decide how a step is made."""

from __future__ import annotations

from dataclasses import dataclass


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
    inputs_by_position
        An input acts through the position.
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
    inputs_by_position: bool = False

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
