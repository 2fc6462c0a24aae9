"""Short forms of a scene: a constant mass with one damping rate, and a scene without a closed form."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian
from herglotz.scenes.exact import exact_discrete_lagrangian
from herglotz.scenes.forced import External, ForcedRule
from herglotz.scenes.motion import herglotz_motion
from herglotz.scenes.reference import reference_flow
from herglotz.scenes.rules import all_rules
from herglotz.scenes.scene import Scene, StateFunction


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


def scene_without_closed_form(
    *,
    lagrangian: StateFunction,
    momentum: StateFunction,
    velocity: StateFunction,
    force: StateFunction,
    rate: StateFunction,
    rules: Mapping[str, DiscreteLagrangian] | None = None,
    external: External | None = None,
    **fields: Any,
) -> Scene:
    """The scene whose flow and exact L_d are computed, from L with its derivatives written out.

    Parameters
    ----------
    force, rate
        L_q(q, v, s), (..., n), and L_s(q, v, s), (...): written out, so that the flow is fast and differentiable. The
        tests hold them to `contact_vector_field` of the Hamiltonian.
    rules
        Discretisations beside the general ones of `rules.py`, or instead of those of the same name.
    external
        f(q, v), (..., n), a force beside the Lagrangian's: the rules carry it, and there is no exact L_d.
    fields
        The other fields of `Scene`.
    """
    general = all_rules(lagrangian)
    if external is None:
        motion = herglotz_motion(lagrangian, momentum, velocity, force, rate)
    else:
        general = {name: ForcedRule(rule, external) for name, rule in general.items()}
        whole = lambda q, v, s: force(q, v, s) + external(q, v)  # noqa: E731
        motion = herglotz_motion(lagrangian, momentum, velocity, whole, rate)
    offered = {**general, **(rules or {})}
    return Scene(
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
