"""Scenes without a closed form, among them scenes with a constant mass and a constant damping rate.

A scene may have an external force that no L(q, v, s) of a single action s describes, for example friction of one joint:
ṗ = L_q + L_s p + f(q, v) (Lagrange–d'Alembert–Herglotz). The motion is then no contact flow and has no exact discrete
Lagrangian; the rules are discrete Lagrangians with discrete forces.

A scene with one coordinate and a given force has L = m v²/2 − V(q) + u q − γs. The force u is held over a step, as by
the amplifier of a motor, so that a motion is a product of contact maps, each with its own Lagrangian L_d^k = L_d(·;
u_k).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian, Forced
from herglotz.mechanics.partials import derivatives
from herglotz.scenes.exact import exact_discrete_lagrangian
from herglotz.scenes.reference import constant_rate, herglotz_motion, reference_flow
from herglotz.scenes.rules import all_rules, strang
from herglotz.scenes.scene import Scene, State, StateFunction
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
    velocity: StateFunction,
    force: StateFunction,
    rate: StateFunction | float,
    momentum: StateFunction | None = None,
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
    momentum, hamiltonian
        L_v(q, v, s), by default by autograd, and H(q, p, s), by default p·v − L(q, v, s) at v = `velocity`(q, p, s).
    rules
        Discretisations in addition to those of `rules.py`, which rules of the same name replace.
    external
        f(q, v), (..., n), a force besides that of the Lagrangian: the rules have discrete forces, and no L_d is exact.
    fields
        The other fields of `Scene`.
    """
    momentum = momentum or (lambda q, v, s: derivatives(lagrangian, q, v, s).D2)
    offered: Mapping[str, DiscreteLagrangian] = {**all_rules(lagrangian), **(rules or {})}
    total, rate = force, rate if callable(rate) else constant_rate(rate)
    if external is not None:
        offered = {name: ForcedRule(rule, external) for name, rule in offered.items()}
        total = lambda q, v, s: force(q, v, s) + external(q, v)  # noqa: E731
    motion = herglotz_motion(lagrangian, momentum, velocity, total, rate)

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
    **fields: Any,
) -> Scene:
    """The scene of L = m|v|²/2 − V(q) − γs, with the composition `strang` among its rules.

    Parameters
    ----------
    potential, slope
        V(q), (...), and its gradient, (..., n).
    gamma, m
        Damping rate, and mass.
    fields
        The other fields of `Scene`.
    """
    system = Natural(potential, gamma, m)
    return scene_without_closed_form(
        **system.functions(),
        force=lambda q, v, s: -slope(q),  # noqa: ARG005
        rate=-gamma,
        rules={"strang": strang(potential, m, gamma)},
        **fields,
    )


@dataclass(frozen=True)
class DrivenRule:
    """L_d at the input `u0`; `at(u)` is L_d of a step with the input u, (..., 1).

    Source: section 6 of `docs/mathematics.md`, time-dependent L_d.
    """

    rule: Callable[[Tensor | float], DiscreteLagrangian]
    u0: float

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L_d, shape (...)."""
        return self.rule(self.u0)(q0, q1, s0, h)

    def forces(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> tuple[Tensor, Tensor] | None:
        """F⁻ and F⁺ of the rule, (..., n) each; None for a rule without forces."""
        own = self.rule(self.u0)
        return own.forces(q0, q1, s0, h) if isinstance(own, Forced) else None

    def at(self, u: Tensor) -> DiscreteLagrangian:
        """The discrete Lagrangian of a step whose input is u, (..., 1)."""
        return self.rule(u[..., 0])


def driven_scene(
    potential: Callable[[Tensor], Tensor],
    slope: Callable[[Tensor], Tensor],
    gamma: float,
    amplitude: float,
    frequency: float,
    *,
    m: float = 1.0,
    external: External | None = None,
    flow: Callable[..., State] | None = None,
    **fields: Any,
) -> Scene:
    """The scene of a potential, one damping rate and the force u(t) = A cos νt.

    The scene's functions have the force at t = 0; `at(u)` is the scene at the force u, and `drive(t)` is u(t).

    Parameters
    ----------
    potential, slope
        V(q), (...), and V'(q), (..., 1).
    gamma
        Damping rate γ.
    amplitude, frequency
        A, and the angular frequency ν.
    m
        Mass.
    external
        f(q, v), a force besides that of the Lagrangian.
    flow
        (u, q, p, s, h) → (q1, p1, s1) if known; by default the reference flow.
    fields
        The other fields of `Scene`.
    """

    def held(u: Tensor | float) -> Scene:
        """The scene under a constant force."""
        return natural_scene(
            lambda q: potential(q) - u * q[..., 0],
            lambda q: slope(q) - (u[..., None] if isinstance(u, Tensor) else u),
            gamma,
            m,
            external=external,
            **fields,
        )

    def rule(name: str) -> DrivenRule:
        return DrivenRule(lambda u: held(u).L_d_rules[name], amplitude)

    rules = {name: rule(name) for name in held(amplitude).L_d_rules}

    def scene_at(u: Tensor | float) -> Scene:
        made = held(u)
        return replace(
            made,
            flow=made.flow if flow is None else partial(flow, u),
            L_d=rules["midpoint_heun"],
            L_d_rules=rules,
            at=lambda u: scene_at(u[..., 0]),
            drive=lambda t: amplitude * torch.cos(frequency * t)[..., None],
        )

    return scene_at(amplitude)
