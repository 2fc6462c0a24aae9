"""The damped double pendulum, m = ℓ = 1, angles from the vertical: chaotic, no closed form.

L = v1² + v2²/2 + v1v2 cos(q1 − q2) − g[2(1 − cos q1) + (1 − cos q2)] − γs. The default ranges start below the
horizontal, |q| ≤ 1.2 rad and |v| ≤ 1.5 rad/s, where the motion is only weakly chaotic: reference and computed motions
can be compared for tens of seconds.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.scenes.natural import scene_without_closed_form
from herglotz.scenes.scene import Scene


def double_pendulum(g: float = 9.81, gamma: float = 0.1) -> Scene:
    """Two equal pendulums in a chain, one damping rate.

    Parameters
    ----------
    g
        Gravity over length, 1/s².
    gamma
        Damping rate γ, 1/s; one scalar s damps both momenta alike (trap 4 of `docs/mathematics.md`).
    """

    def potential(q: Tensor) -> Tensor:
        # 1 − cos q = 2 sin²(q/2) does not cancel.
        height = 2.0 * torch.sin(0.5 * q) ** 2
        return g * (2.0 * height[..., 0] + height[..., 1])

    def lagrangian(q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        v1, v2 = v.unbind(-1)
        kinetic = v1**2 + 0.5 * v2**2 + v1 * v2 * torch.cos(q[..., 0] - q[..., 1])
        return kinetic - potential(q) - gamma * s

    def velocity(q: Tensor, p: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        (p1, p2), C = p.unbind(-1), torch.cos(q[..., 0] - q[..., 1])
        return torch.stack([p1 - C * p2, 2 * p2 - C * p1], -1) / (2 - C * C)[..., None]

    def force(q: Tensor, v: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        twist = torch.sin(q[..., 0] - q[..., 1]) * v[..., 0] * v[..., 1]
        weight = g * torch.sin(q)
        return torch.stack([-twist - 2 * weight[..., 0], twist - weight[..., 1]], -1)

    return scene_without_closed_form(
        name="double_pendulum",
        description="damped double pendulum, m = ℓ = 1; no closed form, reference flow to about 1e-13",
        coordinates=("theta1", "theta2"),
        units=("rad", "rad"),
        parameters={"g": g, "gamma": gamma},
        lagrangian=lagrangian,
        velocity=velocity,
        force=force,
        rate=-gamma,
        q_range=(-1.2, 1.2),
        v_range=(-1.5, 1.5),
        h=0.05,
        examples=({"g": 4.0, "gamma": 0.4},),
    )
