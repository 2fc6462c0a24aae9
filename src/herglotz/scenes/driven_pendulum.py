"""A damped pendulum driven by a torque, θ̈ = −sin θ − γθ̇ + u: a discrete Lagrangian for each step.

L = v²/2 − (1 − cos q) + u q − γs, in units where m = ℓ = g = 1. The torque u is given and held over a step, as the
amplifier of a motor holds it, so that a motion is a product of contact maps, one Lagrangian L_d^k = L_d(·; u_k) each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian
from herglotz.scenes.motion import constant_rate
from herglotz.scenes.natural import Natural, scene_without_closed_form
from herglotz.scenes.rules import RULES, strang
from herglotz.scenes.scene import Scene


@dataclass(frozen=True)
class DrivenRule:
    """L_d at the torque `torque`; `at(u)` is the one of a step with the torque u, (..., 1).

    Source: section 6 of `docs/mathematics.md`, time-dependent L_d.
    """

    rule: Callable[[Tensor | float], DiscreteLagrangian]
    torque: float

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L_d, shape (...)."""
        return self.rule(self.torque)(q0, q1, s0, h)

    def at(self, u: Tensor) -> DiscreteLagrangian:
        """The discrete Lagrangian of a step whose torque is u, (..., 1)."""
        return self.rule(u[..., 0])


def driven_pendulum(gamma: float = 0.2, amplitude: float = 0.4, frequency: float = 1.2) -> Scene:
    """A pendulum with damping and the torque u(t) = A cos νt, held over each step of a simulation.

    The scene's own functions are those of the torque at t = 0; `at(u)` gives the scene of any other, and
    `drive(t)` the torque.

    Parameters
    ----------
    gamma
        Damping rate γ, per unit of time √(ℓ/g).
    amplitude
        Torque A, in units of mgℓ.
    frequency
        Angular frequency ν of the torque, rad per unit of time.
    """

    def potential_at(u: Tensor | float) -> Callable[[Tensor], Tensor]:
        return lambda q: 2.0 * torch.sin(0.5 * q[..., 0]) ** 2 - u * q[..., 0]  # 1 − cos q without its cancellation

    def system_at(u: Tensor | float) -> Natural:
        return Natural(potential_at(u), gamma)

    def drive(t: Tensor) -> Tensor:
        return amplitude * torch.cos(frequency * t)[..., None]

    def driven(make: Callable[[Tensor | float], DiscreteLagrangian]) -> DrivenRule:
        return DrivenRule(make, amplitude)

    rules: dict[str, DiscreteLagrangian] = {}
    for name, rule in RULES.items():
        if name.startswith("lobatto"):  # evaluates L at several nodes at once: no broadcast of u
            rules[name] = rule(system_at(amplitude).lagrangian)
        else:
            rules[name] = driven(lambda u, r=rule: r(system_at(u).lagrangian))
    rules["strang"] = driven(lambda u: strang(potential_at(u), 1.0, gamma))

    def scene_at(u: Tensor | float) -> Scene:
        system = system_at(u)

        def force(q: Tensor, v: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
            torque = u[..., None] if isinstance(u, Tensor) else u
            return torque - torch.sin(q)

        return scene_without_closed_form(
            name="driven_pendulum",
            description="damped pendulum under a given torque, θ̈ = −sin θ − γθ̇ + u; reference flow to about 1e-13",
            dof=1,
            coordinates=("theta",),
            units=("rad",),
            time_unit="s",
            angles=(True,),
            parameters={"gamma": gamma, "amplitude": amplitude, "frequency": frequency},
            hamiltonian=system.hamiltonian,
            lagrangian=system.lagrangian,
            momentum=system.momentum,
            velocity=system.velocity,
            force=force,
            rate=constant_rate(-gamma),
            rules=rules,
            q_range=(-2.0, 2.0),
            v_range=(-1.2, 1.2),
            h=0.2,
            examples=({"gamma": 0.35, "amplitude": 0.7, "frequency": 0.9},),
            at=lambda u: scene_at(u[..., 0]),
            drive=drive,
        )

    return scene_at(amplitude)
