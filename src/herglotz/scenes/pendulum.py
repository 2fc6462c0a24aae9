"""The damped pendulum, θ̈ = −sin θ − γθ̇ + u, free or driven by a torque u, in units where m = ℓ = g = 1.

L = v²/2 − (1 − cos q) − γs and H = p²/2 + (1 − cos q) + γs. There is no closed form; the answer is the reference flow.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.scenes.natural import driven_scene, natural_scene
from herglotz.scenes.scene import Scene


def lifted(q: Tensor) -> Tensor:
    """V = 1 − cos q = 2 sin²(q/2), which does not cancel."""
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


def driven_pendulum(gamma: float = 0.2, amplitude: float = 0.4, frequency: float = 1.2) -> Scene:
    """A pendulum with damping and the torque u(t) = A cos νt, held over each step of a simulation.

    Parameters
    ----------
    gamma
        Damping rate γ, per unit of time √(ℓ/g).
    amplitude, frequency
        Torque A, in units of mgℓ, and its angular frequency ν, rad per unit of time.
    """
    return driven_scene(
        lifted,
        torch.sin,
        gamma,
        amplitude,
        frequency,
        name="driven_pendulum",
        description="damped pendulum under a given torque, θ̈ = −sin θ − γθ̇ + u; reference flow to about 1e-13",
        coordinates=("theta",),
        units=("rad",),
        parameters={"gamma": gamma, "amplitude": amplitude, "frequency": frequency},
        q_range=(-2.0, 2.0),
        v_range=(-1.2, 1.2),
        h=0.2,
        examples=({"gamma": 0.35, "amplitude": 0.7, "frequency": 0.9},),
    )
