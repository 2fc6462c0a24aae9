"""Scenes without a closed form, among them scenes with a constant mass and a constant damping rate.

A scene may have an external force that no L(q, v, s) of a single action s describes, for example friction of one joint:
ṗ = L_q + L_s p + f(q, v) (Lagrange–d'Alembert–Herglotz). The motion is then no contact flow and has no exact discrete
Lagrangian; the rules are discrete Lagrangians with discrete forces.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian
from herglotz.scenes.exact import exact_discrete_lagrangian
from herglotz.scenes.motion import constant_rate, herglotz_motion
from herglotz.scenes.reference import reference_flow
from herglotz.scenes.rules import all_rules, strang
from herglotz.scenes.scene import Scene, StateFunction
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


@dataclass(frozen=True)
class Natural:
    """L = m|v|²/2 − V(q) − γs, with H = |p|²/2m + V(q) + γs and p = mv."""

    potential: Callable[[Tensor], Tensor]
    gamma: float
    m: float = 1.0

    def lagrangian(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        """L, (...)."""
        return 0.5 * self.m * (v * v).sum(-1) - self.potential(q) - self.gamma * s

    def hamiltonian(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """H, (...)."""
        return (p * p).sum(-1) / (2 * self.m) + self.potential(q) + self.gamma * s

    def momentum(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:  # noqa: ARG002
        """P = L_v, (..., n)."""
        return self.m * v

    def velocity(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:  # noqa: ARG002
        """V = H_p, (..., n)."""
        return p / self.m

    def functions(self) -> dict[str, Any]:
        """The four fields of `Scene` with these functions, by name."""
        return {name: getattr(self, name) for name in ("hamiltonian", "lagrangian", "momentum", "velocity")}


def scene_without_closed_form(
    *,
    lagrangian: StateFunction,
    momentum: StateFunction,
    velocity: StateFunction,
    force: StateFunction,
    rate: StateFunction | float,
    hamiltonian: StateFunction | None = None,
    rules: Mapping[str, DiscreteLagrangian] | None = None,
    external: External | None = None,
    **fields: Any,
) -> Scene:
    """The scene of an L with written-out derivatives, whose flow and exact L_d are computed numerically.

    Parameters
    ----------
    force, rate
        L_q(q, v, s), (..., n), and L_s(q, v, s), (...), or its constant value: written out, so that the flow is fast
        and differentiable. The tests compare them with `contact_vector_field` of the Hamiltonian.
    hamiltonian
        H(q, p, s); by default p·v − L(q, v, s) at v = `velocity`(q, p, s).
    rules
        Discretisations in addition to those of `rules.py`, which rules of the same name replace.
    external
        f(q, v), (..., n), a force besides that of the Lagrangian: the rules have discrete forces, and no L_d is exact.
    fields
        The other fields of `Scene`.
    """
    general, rate = all_rules(lagrangian), rate if callable(rate) else constant_rate(rate)
    if external is None:
        motion = herglotz_motion(lagrangian, momentum, velocity, force, rate)
    else:
        general = {name: ForcedRule(rule, external) for name, rule in general.items()}
        total = lambda q, v, s: force(q, v, s) + external(q, v)  # noqa: E731
        motion = herglotz_motion(lagrangian, momentum, velocity, total, rate)
    offered = {**general, **(rules or {})}

    def energy(q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        v = velocity(q, p, s)
        return (p * v).sum(-1) - lagrangian(q, v, s)

    return Scene(
        hamiltonian=hamiltonian or energy,
        lagrangian=lagrangian,
        momentum=momentum,
        velocity=velocity,
        flow=partial(reference_flow, motion.vector_field),
        L_d=offered["midpoint_heun"],
        exact=False,
        L_d_rules=offered,
        numerical=None if external else exact_discrete_lagrangian(motion),
        external=external,
        **fields,
    )


def natural_scene(
    potential: Callable[[Tensor], Tensor],
    slope: Callable[[Tensor], Tensor],
    gamma: float,
    m: float = 1.0,
    *,
    rules: Mapping[str, DiscreteLagrangian] | None = None,
    **fields: Any,
) -> Scene:
    """The scene of L = m|v|²/2 − V(q) − γs.

    Parameters
    ----------
    potential, slope
        V(q), (...), and its gradient, (..., n).
    gamma, m
        Damping rate, and mass.
    rules
        Discretisations in addition to those of `rules.py`; by default the composition `strang`.
    fields
        The other fields of `Scene`.
    """
    system = Natural(potential, gamma, m)
    return scene_without_closed_form(
        **system.functions(),
        force=lambda q, v, s: -slope(q),  # noqa: ARG005
        rate=-gamma,
        rules={"strang": strang(potential, m, gamma)} if rules is None else rules,
        **fields,
    )
