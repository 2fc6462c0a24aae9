"""A damped pendulum driven by a torque, θ̈ = −sin θ − γθ̇ + u, in units where m = ℓ = g = 1."""

from __future__ import annotations

import torch

from herglotz.scenes.driven import driven_scene
from herglotz.scenes.pendulum import lifted
from herglotz.scenes.scene import Scene


def driven_pendulum(gamma: float = 0.2, amplitude: float = 0.4, frequency: float = 1.2) -> Scene:
    """A pendulum with damping and the torque u(t) = A cos νt, held over each step of a simulation.

    Parameters
    ----------
    gamma
        Damping rate γ, per unit of time √(ℓ/g).
    amplitude
        Torque A, in units of mgℓ.
    frequency
        Angular frequency ν of the torque, rad per unit of time.
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
