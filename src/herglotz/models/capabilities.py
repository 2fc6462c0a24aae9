"""The terms of a model: the description by which stepping, fitting and export decide what is possible."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Capabilities:
    """The terms of a model, and properties of a step that follow from the terms.

    A new term is a field here; every other room reads the properties below and never a term.
    """

    order: int  # of the rule: 2, or 4 with the correction of `herglotz.models.order4`
    baseline: bool  # a kinetic term and a potential; without, the correction is the whole of A
    constant_mass: bool  # K = Δᵀ m Δ / 2h with a constant matrix m
    constant_c: bool  # c depends on h alone: no damping, or a constant rate γ
    known_damping: bool  # the damping, if any, is a constant rate γ or the affine level's g(q̄, v)
    correction: bool  # a network N of (q̄, v)
    action_flow: bool  # the full level: the map of s is nonlinear
    nonlinear_force: bool  # dry friction, or another force that is not linear in v
    sticking: bool  # dry friction is set-valued
    coupling: bool  # a force that depends on the velocities of other joints, or on the position

    @property
    def carries_s(self) -> bool:
        """Whether the positions depend on s at all, as at the affine and full levels."""
        return not self.constant_c

    @property
    def linear_in_q1(self) -> bool:
        """Whether the step equation, forces included, is linear in q1, so that a single Newton step solves it."""
        linear = not (self.correction or self.nonlinear_force)
        return self.order == 2 and self.constant_c and self.constant_mass and linear

    @property
    def by_terms(self) -> bool:
        """Whether the step equation is known term by term (`herglotz.stepping.equation`); else jets evaluate L_d."""
        whole = self.baseline and self.constant_mass and self.known_damping and self.order == 2
        return whole and not (self.action_flow or self.coupling or self.sticking)

    @property
    def explicit(self) -> bool:
        """Whether the step has a closed form (`herglotz.stepping.explicit`): no iteration."""
        return self.linear_in_q1 and self.by_terms


def capabilities(L_d: object) -> Capabilities | None:
    """The capabilities that L_d states; None for a discrete Lagrangian that is no model, whose terms are not known."""
    found = getattr(L_d, "capabilities", None)
    return found if isinstance(found, Capabilities) else None
