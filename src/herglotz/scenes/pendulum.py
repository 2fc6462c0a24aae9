"""The damped pendulum, θ̈ = −sin θ − γθ̇: nonlinear, no closed form, so its answer is the reference flow.

L = v²/2 − (1 − cos q) − γs and H = p²/2 + (1 − cos q) + γs, in units where m = ℓ = g = 1.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.scenes.natural import natural_scene
from herglotz.scenes.scene import Scene


def lifted(q: Tensor) -> Tensor:
    """V = 1 − cos q, without its cancellation."""
    return 2.0 * torch.sin(0.5 * q[..., 0]) ** 2


def damped_pendulum(gamma: float = 0.2) -> Scene:
    """The damped pendulum θ̈ = −sin θ − γθ̇.

    Parameters
    ----------
    gamma
        Damping rate γ, per unit of time √(ℓ/g).
    """
    return natural_scene(
        lifted,
        torch.sin,
        gamma,
        name="damped_pendulum",
        description="damped pendulum, θ̈ = −sin θ − γθ̇; no closed form, reference flow to about 1e-13",
        coordinates=("theta",),
        units=("rad",),
        parameters={"gamma": gamma},
        q_range=(-2.5, 2.5),
        v_range=(-1.5, 1.5),
        h=0.5,
        examples=({"gamma": 0.35},),
    )
