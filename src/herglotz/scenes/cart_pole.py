"""A pendulum that hangs from a cart: one length and one angle, and a mass matrix that depends on the angle.

L = (M + m) v_x²/2 + m ℓ cos θ v_x v_θ + m ℓ² v_θ²/2 − m g ℓ (1 − cos θ) − γs, with θ = 0 where the pole hangs at rest.
L does not depend on x, so the momentum p_x falls as e^{−γt}.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.scenes.natural import scene_without_closed_form
from herglotz.scenes.scene import Scene, require_positive


def cart_pole(cart: float = 1.0, m: float = 0.3, length: float = 0.5, g: float = 9.81, gamma: float = 0.1) -> Scene:
    """A cart with a hanging pole, one damping rate.

    Parameters
    ----------
    cart, m
        Masses M of the cart and m at the end of the pole, kg.
    length, g
        Length ℓ of the pole, m, and gravity, m/s².
    gamma
        Damping rate γ, 1/s; one scalar s damps both momenta alike (trap 4 of `docs/mathematics.md`).

    Raise InputError if a mass or the length is not positive.
    """
    require_positive("cart_pole", cart=cart, m=m, length=length)
    first, third = cart + m, m * length * length

    def second(q: Tensor) -> Tensor:
        return m * length * torch.cos(q[..., 1])

    def lagrangian(q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        vx, vt = v.unbind(-1)
        kinetic = 0.5 * first * vx**2 + second(q) * vx * vt + 0.5 * third * vt**2
        # 1 − cos θ = 2 sin²(θ/2) does not cancel.
        potential = 2.0 * m * g * length * torch.sin(0.5 * q[..., 1]) ** 2
        return kinetic - potential - gamma * s

    def velocity(q: Tensor, p: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        (px, pt), between = p.unbind(-1), second(q)
        determinant = first * third - between * between
        return torch.stack([third * px - between * pt, first * pt - between * px], -1) / determinant[..., None]

    def force(q: Tensor, v: Tensor, s: Tensor) -> Tensor:  # noqa: ARG001
        turn = -m * length * torch.sin(q[..., 1]) * (v[..., 0] * v[..., 1] + g)
        return torch.stack([torch.zeros_like(turn), turn], -1)

    return scene_without_closed_form(
        name="cart_pole",
        description="pendulum that hangs from a cart, one length and one angle; reference flow to about 1e-13",
        coordinates=("x", "theta"),
        units=("m", "rad"),
        parameters={"cart": cart, "m": m, "length": length, "g": g, "gamma": gamma},
        lagrangian=lagrangian,
        velocity=velocity,
        force=force,
        rate=-gamma,
        q_range=((-0.5, -1.2), (0.5, 1.2)),
        v_range=((-0.5, -2.0), (0.5, 2.0)),
        h=0.05,
        examples=({"cart": 1.3, "m": 0.6, "length": 0.8, "g": 4.0, "gamma": 0.4},),
    )
