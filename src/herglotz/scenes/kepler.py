"""The planar Kepler problem with linear drag: L = m|v|²/2 + k/|q| − γs, no closed form.

The body moves on a slowly shrinking ellipse. The default ranges start near |q| = 1 with nearly the speed √(k/m) = 1 of
a circular orbit, 0.8 ≤ v_y ≤ 1.2 and |v_x| ≤ 0.2, so that |q| stays above 0.15 over the first revolutions. L is
singular at q = 0, and steps near or across q = 0 have no order.
"""

from __future__ import annotations

from torch import Tensor

from herglotz.scenes.natural import natural_scene
from herglotz.scenes.scene import Scene, require_positive


def kepler(m: float = 1.0, k: float = 1.0, gamma: float = 0.05) -> Scene:
    """A planet in the plane with linear drag, m q̈ = −k q/|q|³ − mγq̇.

    Parameters
    ----------
    m, k
        Mass, kg, and strength of the attraction, N·m²; negative repels.
    gamma
        Damping rate γ, 1/s.

    Raise InputError if m ≤ 0.
    """
    require_positive("kepler", mass_m=m)

    def potential(q: Tensor) -> Tensor:
        return -k / (q * q).sum(-1).sqrt()

    return natural_scene(
        potential,
        lambda q: k * q * (q * q).sum(-1, keepdim=True) ** -1.5,
        gamma,
        m,
        name="kepler",
        description="planar Kepler problem with linear drag; no closed form, reference flow to about 1e-13",
        coordinates=("x", "y"),
        units=("m", "m"),
        parameters={"m": m, "k": k, "gamma": gamma},
        q_range=((0.8, -0.3), (1.2, 0.3)),
        v_range=((-0.2, 0.8), (0.2, 1.2)),
        h=0.1,
        examples=({"m": 1.3, "k": 0.9, "gamma": 0.2},),
    )
