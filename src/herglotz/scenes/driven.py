"""Scenes with one coordinate and a given force: a discrete Lagrangian for each step.

L = m v²/2 − V(q) + u q − γs. The force u is held over a step, as by the amplifier of a motor, so that a motion is a
product of contact maps, each with its own Lagrangian L_d^k = L_d(·; u_k).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian, Forced
from herglotz.scenes.natural import External, ForcedRule, Natural, natural_scene
from herglotz.scenes.rules import RULES, strang
from herglotz.scenes.scene import Scene, State


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


def _rules(
    system_at: Callable[[Tensor | float], Natural], amplitude: float, external: External | None
) -> dict[str, DiscreteLagrangian]:
    """The rules of the system at each input, with the external force."""

    def forced(rule: DiscreteLagrangian) -> DiscreteLagrangian:
        return rule if external is None else ForcedRule(rule, external)

    def composed(u: Tensor | float) -> DiscreteLagrangian:
        system = system_at(u)
        return forced(strang(system.potential, system.m, system.gamma))

    rules: dict[str, DiscreteLagrangian] = {
        name: DrivenRule(lambda u, r=rule: forced(r(system_at(u).lagrangian)), amplitude)
        for name, rule in RULES.items()
    }
    return rules | {"strang": DrivenRule(composed, amplitude)}


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

    def potential_at(u: Tensor | float) -> Callable[[Tensor], Tensor]:
        return lambda q: potential(q) - u * q[..., 0]

    def system_at(u: Tensor | float) -> Natural:
        return Natural(potential_at(u), gamma, m)

    def drive(t: Tensor) -> Tensor:
        return amplitude * torch.cos(frequency * t)[..., None]

    rules = _rules(system_at, amplitude, external)

    def scene_at(u: Tensor | float) -> Scene:
        made = natural_scene(
            potential_at(u),
            lambda q: slope(q) - (u[..., None] if isinstance(u, Tensor) else u),
            gamma,
            m,
            rules=rules,
            at=lambda u: scene_at(u[..., 0]),
            drive=drive,
            external=external,
            **fields,
        )
        return made if flow is None else replace(made, flow=partial(flow, u))

    return scene_at(amplitude)
