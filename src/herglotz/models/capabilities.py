"""What a model is made of: the one description that stepping, fitting and export read to decide what they can do."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Capabilities:
    """The terms of a model, and what follows from them for one step.

    A new term states itself here once; every other room asks the properties below and looks at no term.
    """

    order: int  # of the rule: 2, or 4 with what order 2 lacks (`herglotz.models.order4`)
    baseline: bool  # a kinetic term and a potential; without, the correction is the whole of A
    constant_mass: bool  # K = Δᵀ m Δ / 2h with one matrix m
    constant_c: bool  # c depends on h alone: no damping, or one rate γ
    known_damping: bool  # the damping, if any, is one rate γ or the affine level's g(q̄, v)
    correction: bool  # a network N of (q̄, v)
    action_flow: bool  # the full level: the map of s is nonlinear
    nonlinear_force: bool  # dry friction, or another force that is not linear in v
    sticking: bool  # dry friction is set-valued
    coupling: bool  # a force that depends on the velocities of other joints, or on the position

    @property
    def carries_s(self) -> bool:
        """Whether the positions depend on s at all (they do at the affine and full levels)."""
        return not self.constant_c

    @property
    def linear_in_q1(self) -> bool:
        """Whether the step equation is linear in q1, so that one Newton step solves it (forces may be part of it)."""
        linear = not (self.correction or self.nonlinear_force)
        return self.order == 2 and self.constant_c and self.constant_mass and linear

    @property
    def by_terms(self) -> bool:
        """Whether the step equation is known term by term (`herglotz.stepping.equation`); else jets evaluate it."""
        whole = self.baseline and self.constant_mass and self.known_damping and self.order == 2
        return whole and not (self.action_flow or self.coupling or self.sticking)

    @property
    def explicit(self) -> bool:
        """Whether the step has a closed form (`herglotz.stepping.explicit`): no iteration."""
        return self.linear_in_q1 and self.by_terms


def capabilities(L_d: object) -> Capabilities | None:
    """What L_d says of itself; None for a discrete Lagrangian that is no model: nothing is known of its terms."""
    found = getattr(L_d, "capabilities", None)
    return found if isinstance(found, Capabilities) else None
