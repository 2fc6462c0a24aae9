"""A chain of equal masses between two walls, with hardening springs and one damping rate.

L = Σ_i m v_i²/2 − Σ_j (k d_j²/2 + β d_j⁴/4) − γs with the stretches d = (q_1, q_2 − q_1, …, q_N − q_{N−1}, −q_N). The
damping is uniform, m q̈ = F − mγq̇, so one scalar s describes the damping of any number of masses exactly.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.scenes.natural import natural_scene
from herglotz.scenes.scene import Scene, require_positive


def chain(masses: float = 10, m: float = 1.0, k: float = 1.0, beta: float = 0.5, gamma: float = 0.1) -> Scene:
    """Masses in a row between two walls, each joined to its neighbours by a spring of force k d + β d³.

    Parameters
    ----------
    masses
        Number of masses N ≥ 1, the degrees of freedom.
    m, k
        Each mass, kg, and stiffness of a spring, N/m. At β = 0 the frequencies are 2√(k/m) sin(jπ/(2N + 2)), j = 1 … N.
    beta
        Hardening β ≥ 0 of a spring, N/m³.
    gamma
        Damping rate γ, 1/s, the same for every mass.

    Raise InputError if `masses` is not a whole number ≥ 1, m ≤ 0, k ≤ 0 or β < 0.

    Source: E. Fermi, J. Pasta and S. Ulam, Studies of nonlinear problems, Los Alamos report LA-1940 (1955): their
    chain with cubic forces, here damped.
    """
    if masses < 1 or masses != int(masses):
        raise InputError(f"chain: masses must be a whole number >= 1, got {masses}")
    require_positive("chain", mass_m=m, stiffness_k=k)
    if not beta >= 0:
        raise InputError(f"chain: hardening beta must be >= 0, got {beta}")
    n = int(masses)

    def stretches(q: Tensor) -> Tensor:
        """(..., n) → (..., n + 1)."""
        wall = torch.zeros_like(q[..., :1])
        return torch.diff(torch.cat([wall, q, wall], -1))

    def potential(q: Tensor) -> Tensor:
        d2 = stretches(q) ** 2
        return (d2 * (0.5 * k + 0.25 * beta * d2)).sum(-1)

    def slope(q: Tensor) -> Tensor:
        d = stretches(q)
        return -torch.diff(d * (k + beta * d * d))

    return natural_scene(
        potential,
        slope,
        gamma,
        m,
        name="chain",
        description="masses between two walls, hardening springs, one damping rate; reference flow to about 1e-13",
        coordinates=tuple(f"x{i + 1}" for i in range(n)),
        units=("m",) * n,
        parameters={"masses": n, "m": m, "k": k, "beta": beta, "gamma": gamma},
        q_range=(-0.5, 0.5),
        v_range=(-0.5, 0.5),
        h=0.2,
        examples=({"masses": 3, "m": 1.3, "k": 0.8, "beta": 1.1, "gamma": 0.3},),
    )
