"""The damped pendulum, θ̈ = −sin θ − γθ̇: nonlinear, no closed form, so its answer is the reference flow.

L = v²/2 − (1 − cos q) − γs and H = p²/2 + (1 − cos q) + γs, in units where m = ℓ = g = 1.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.scenes.motion import constant_rate
from herglotz.scenes.natural import Natural, scene_without_closed_form
from herglotz.scenes.rules import strang
from herglotz.scenes.scene import Scene


def damped_pendulum(gamma: float = 0.2) -> Scene:
    """The damped pendulum θ̈ = −sin θ − γθ̇.

    Parameters
    ----------
    gamma
        Damping rate γ, per unit of time √(ℓ/g).
    """

    def potential(q: Tensor) -> Tensor:
        return 2.0 * torch.sin(0.5 * q[..., 0]) ** 2  # 1 − cos q, without its cancellation

    def force(q: Tensor, v: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        return -torch.sin(q)

    system = Natural(potential, gamma)
    return scene_without_closed_form(
        name="damped_pendulum",
        description="damped pendulum, θ̈ = −sin θ − γθ̇; no closed form, reference flow to about 1e-13",
        dof=1,
        coordinates=("theta",),
        units=("rad",),
        time_unit="s",
        angles=(True,),
        parameters={"gamma": gamma},
        hamiltonian=system.hamiltonian,
        lagrangian=system.lagrangian,
        momentum=system.momentum,
        velocity=system.velocity,
        force=force,
        rate=constant_rate(-gamma),
        rules={"strang": strang(potential, 1.0, gamma)},
        q_range=(-2.5, 2.5),
        v_range=(-1.5, 1.5),
        h=0.5,
        examples=({"gamma": 0.35},),
    )
