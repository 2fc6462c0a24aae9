"""Duffing's oscillator, ẍ = −γẋ − kx − βx³ + u, free or driven by a force u; its answer is the reference flow.

L = v²/2 − kx²/2 − βx⁴/4 − γs and H = p²/2 + kx²/2 + βx⁴/4 + γs, with mass 1 kg.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from herglotz.errors import InputError
from herglotz.scenes.natural import driven_scene, natural_scene
from herglotz.scenes.scene import Scene, require_positive


def hardening(k: float, beta: float) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
    """V = kx²/2 + βx⁴/4 and V'."""

    def potential(q: Tensor) -> Tensor:
        x2 = q[..., 0] ** 2
        return x2 * (0.5 * k + 0.25 * beta * x2)

    return potential, lambda q: q * (k + beta * q * q)


def duffing(k: float = 1.0, beta: float = 25.0, gamma: float = 0.15) -> Scene:
    """A mass on a hardening spring.

    At the default numbers and an amplitude of 0.4 m the cubic force is four times the linear one.

    Parameters
    ----------
    k, beta
        Linear stiffness, N/m (negative: two wells), and cubic stiffness β > 0, N/m³.
    gamma
        Damping rate γ, 1/s.

    Raise InputError if β ≤ 0: the potential would have no lower bound.
    """
    if not beta > 0:
        raise InputError(f"duffing: cubic stiffness beta must be > 0, got {beta}; damped_oscillator is linear")

    return natural_scene(
        *hardening(k, beta),
        gamma,
        name="duffing",
        description="oscillator with a hardening spring, ẍ = −γẋ − kx − βx³; reference flow to about 1e-13",
        coordinates=("x",),
        units=("m",),
        parameters={"k": k, "beta": beta, "gamma": gamma},
        q_range=(-0.5, 0.5),
        v_range=(-0.4, 0.4),
        h=0.1,
        examples=({"k": 0.7, "beta": 12.0, "gamma": 0.3}, {"k": -0.6, "beta": 4.0, "gamma": 0.1}),
    )


def driven_duffing(
    k: float = 1.0, beta: float = 4.0, gamma: float = 0.2, amplitude: float = 0.5, frequency: float = 1.3
) -> Scene:
    """A mass on a hardening spring under the force u(t) = A cos νt, held over each step of a simulation.

    Parameters
    ----------
    k, beta, gamma
        As of `duffing`.
    amplitude, frequency
        Force A, N, and its angular frequency ν, rad/s.

    Raise InputError if β ≤ 0.
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
