"""Duffing's oscillator driven by a force, ẍ = −γẋ − kx − βx³ + u, with mass 1 kg."""

from __future__ import annotations

from herglotz.scenes.driven import driven_scene
from herglotz.scenes.duffing import hardening
from herglotz.scenes.scene import Scene, require_positive


def driven_duffing(
    k: float = 1.0, beta: float = 4.0, gamma: float = 0.2, amplitude: float = 0.5, frequency: float = 1.3
) -> Scene:
    """A mass on a hardening spring under the force u(t) = A cos νt, held over each step of a simulation.

    Parameters
    ----------
    k
        Linear stiffness, N/m.
    beta
        Cubic stiffness β > 0, N/m³.
    gamma
        Damping rate γ, 1/s.
    amplitude
        Force A, N.
    frequency
        Angular frequency ν of the force, rad/s.

    Raises
    ------
    InputError
        If β ≤ 0.
    """
    require_positive("driven_duffing", cubic_stiffness_beta=beta)

    return driven_scene(
        *hardening(k, beta),
        gamma,
        amplitude,
        frequency,
        name="driven_duffing",
        description="hardening spring under a given force, ẍ = −γẋ − kx − βx³ + u; reference flow to about 1e-13",
        coordinates=("x",),
        units=("m",),
        parameters={"k": k, "beta": beta, "gamma": gamma, "amplitude": amplitude, "frequency": frequency},
        q_range=(-0.8, 0.8),
        v_range=(-0.8, 0.8),
        h=0.15,
        examples=({"k": 0.7, "beta": 2.5, "gamma": 0.35, "amplitude": 0.3, "frequency": 0.9},),
    )
