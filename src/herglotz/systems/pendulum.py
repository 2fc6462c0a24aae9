"""The damped pendulum, θ̈ = −sin θ − γθ̇: nonlinear, no closed form, so its answer is the reference flow.

L = v²/2 − (1 − cos q) − γs and H = p²/2 + (1 − cos q) + γs, in units where m = ℓ = g = 1.
"""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from herglotz.systems.exact import exact_discrete_lagrangian
from herglotz.systems.motion import constant_rate, herglotz_motion
from herglotz.systems.reference import reference_flow
from herglotz.systems.rules import all_rules, strang
from herglotz.systems.scene import Scene


def damped_pendulum(gamma: float = 0.2) -> Scene:
    """The damped pendulum θ̈ = −sin θ − γθ̇.

    Parameters
    ----------
    gamma
        Damping rate γ, per unit of time √(ℓ/g).
    """

    def potential(q: Tensor) -> Tensor:
        return 2.0 * torch.sin(0.5 * q[..., 0]) ** 2  # 1 − cos q, without its cancellation

    def lagrangian(q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        return 0.5 * v[..., 0] ** 2 - potential(q) - gamma * s

    def hamiltonian(q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        return 0.5 * p[..., 0] ** 2 + potential(q) + gamma * s

    def momentum(q: Tensor, v: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        return v

    def force(q: Tensor, v: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        return -torch.sin(q)

    # Written out, so that the flow is differentiable and fast; a test holds it to `contact_vector_field`.
    motion = herglotz_motion(lagrangian, momentum, momentum, force, constant_rate(-gamma))

    rules = {**all_rules(lagrangian), "strang": strang(potential, 1.0, gamma)}
    return Scene(
        name="damped_pendulum",
        description="damped pendulum, θ̈ = −sin θ − γθ̇; no closed form, reference flow to about 1e-13",
        dof=1,
        coordinates=("theta",),
        units=("rad",),
        time_unit="s",
        angles=(True,),
        parameters={"gamma": gamma},
        hamiltonian=hamiltonian,
        lagrangian=lagrangian,
        momentum=momentum,
        velocity=momentum,
        flow=partial(reference_flow, motion.vector_field),
        L_d=rules["midpoint_heun"],
        exact=False,
        L_d_rules=rules,
        q_range=(-2.5, 2.5),
        v_range=(-1.5, 1.5),
        h=0.5,
        numerical=exact_discrete_lagrangian(motion),
        examples=({"gamma": 0.35},),
    )
