"""A free rigid body with one damping rate, in roll, pitch and yaw: a mass that depends on the position.

L = ½ Ω·JΩ − γs, with Ω = W(q) q̇ the angular velocity in the body frame and q = (φ, θ, ψ) roll, pitch and yaw,
R = R_z(ψ) R_y(θ) R_x(φ). The angular momentum in space, R JΩ, decreases as e^{−γt} in a constant direction.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.scenes.natural import scene_without_closed_form
from herglotz.scenes.scene import Scene


@dataclass(frozen=True)
class FreeBody:
    """L, its derivatives and p ↔ v of the free body; q, v and p are (..., 3), s is (...)."""

    J1: float
    J2: float
    J3: float
    gamma: float

    def sines(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Sine and cosine of roll, then of pitch."""
        roll, pitch = q[..., 0], q[..., 1]
        return torch.sin(roll), torch.cos(roll), torch.sin(pitch), torch.cos(pitch)

    def body_velocity(self, q: Tensor, v: Tensor) -> Tensor:
        """Ω = W(q) v, (..., 3)."""
        (sr, cr, sp, cp), (roll, pitch, yaw) = self.sines(q), v.unbind(-1)
        return torch.stack([roll - yaw * sp, pitch * cr + yaw * cp * sr, yaw * cp * cr - pitch * sr], -1)

    def inertia(self, like: Tensor) -> Tensor:
        """The moments, (3,)."""
        return torch.tensor((self.J1, self.J2, self.J3), dtype=like.dtype, device=like.device)

    def body_momentum(self, q: Tensor, p: Tensor) -> Tensor:
        """M = JΩ = W⁻ᵀ p, (..., 3)."""
        (sr, cr, sp, cp), (p1, p2, p3) = self.sines(q), p.unbind(-1)
        across = (p3 + sp * p1) / cp
        return torch.stack([p1, cr * p2 + sr * across, cr * across - sr * p2], -1)

    def velocity(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:  # noqa: ARG002
        """W⁻¹ J⁻¹ W⁻ᵀ p."""
        (sr, cr, sp, cp), (O1, O2, O3) = self.sines(q), (self.body_momentum(q, p) / self.inertia(p)).unbind(-1)
        yaw = (sr * O2 + cr * O3) / cp
        return torch.stack([O1 + sp * yaw, cr * O2 - sr * O3, yaw], -1)

    def lagrangian(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        """L, (...)."""
        omega = self.body_velocity(q, v)
        return 0.5 * (self.inertia(v) * omega * omega).sum(-1) - self.gamma * s

    def force(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:  # noqa: ARG002
        """L_q = JΩ·Ω_q, with Ω_φ = (0, Ω3, −Ω2) and no yaw in L."""
        J1, J2, J3 = self.J1, self.J2, self.J3
        (sr, cr, sp, cp), (O1, O2, O3), yaw = self.sines(q), self.body_velocity(q, v).unbind(-1), v[..., 2]
        roll = (J2 - J3) * O2 * O3
        pitch = -yaw * (J1 * O1 * cp + sp * (J2 * O2 * sr + J3 * O3 * cr))
        return torch.stack([roll, pitch, torch.zeros_like(roll)], -1)


def rigid_body(J1: float = 3.0, J2: float = 2.0, J3: float = 1.0, gamma: float = 0.1) -> Scene:
    """A rigid body without a torque except uniform damping, J Ω̇ = JΩ × Ω − γJΩ.

    The angles are a chart of the rotations that is singular at a pitch of ±π/2. In the default ranges the body spins
    about its first axis, where pitch and yaw only nutate; `herglotz.theory.RigidBodyStepper` needs no chart.

    Parameters
    ----------
    J1, J2, J3
        Principal moments of inertia, kg m².
    gamma
        Damping rate γ, 1/s.

    Raise InputError if a moment is not positive, or larger than the sum of the others.

    Source: V. I. Arnold, Mathematical Methods of Classical Mechanics, §29; here with the damping of Herglotz.
    """
    moments = sorted((J1, J2, J3))
    if not (moments[0] > 0 and moments[2] <= moments[0] + moments[1]):
        raise InputError(
            f"rigid_body: moments must be > 0, none larger than the sum of the others, got {J1}, {J2}, {J3}"
        )

    body = FreeBody(J1, J2, J3, gamma)
    return scene_without_closed_form(
        name="rigid_body",
        description="free rigid body with one damping rate, in roll, pitch and yaw; reference flow to about 1e-13",
        coordinates=("roll", "pitch", "yaw"),
        units=("rad", "rad", "rad"),
        parameters={"J1": J1, "J2": J2, "J3": J3, "gamma": gamma},
        lagrangian=body.lagrangian,
        velocity=body.velocity,
        force=body.force,
        rate=-gamma,
        q_range=((-1.0, -0.4, -1.0), (1.0, 0.4, 1.0)),
        v_range=((0.8, -0.2, -0.2), (1.2, 0.2, 0.2)),
        h=0.1,
        examples=({"J1": 2.1, "J2": 1.7, "J3": 0.9, "gamma": 0.3},),
    )
