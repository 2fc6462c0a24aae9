"""A linear motor axis with dry friction and no spring, M ẍ = u − d ẋ − F_c sign ẋ + f₀, with true sticking.

L = M v²/2 + (u + f₀) x − γs with γ = d/M: viscous friction is the contact term. Dry friction is set-valued and balances
any force up to F_c at rest. With u held over a step the motion is known piece by piece. Between two events the speed
relaxes as e^{−γt}, so the time of a reversal is a logarithm, and a step has at most two pieces, before and after rest.

The default numbers have the size of a published identification of a motor axis: A. Janot, M. Gautier and M. Brunot,
Data Set and Reference Models of EMPS, 2019 Workshop on Nonlinear System Identification Benchmarks.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.scenes.natural import driven_scene
from herglotz.scenes.scene import Scene, State, Step, require_positive

# L_d has no set-valued force: its dry friction is F_c tanh(v / this width), in m/s, a twentieth of the
# default speeds.
SMOOTH_WIDTH = 0.01
# Gauss–Legendre nodes on [−1, 1] for the action of a piece, exact to a relative error of 1e-14 for γh up to 4.
NODES, WEIGHTS = (x.tolist() for x in np.polynomial.legendre.leggauss(10))


class Axis(NamedTuple):
    """Mass M [kg], damping rate γ [1/s] and dry friction F_c [N] of an axis."""

    m: float
    gamma: float
    dry: float


def servo_axis(
    m: float = 95.1, viscous: float = 203.5, dry: float = 20.4, offset: float = 3.2, amplitude: float = 60.0,
    frequency: float = 3.0,
) -> Scene:  # fmt: skip
    """A motor axis under the force u(t) = A cos νt, held over each step of a simulation.

    Parameters
    ----------
    m, offset
        Moving mass M, kg, and constant force f₀, N, such as an offset of the amplifier.
    viscous, dry
        Viscous friction d ≥ 0, N s/m, and dry (Coulomb) friction F_c ≥ 0, N.
    amplitude, frequency
        Force A of the motor, N, and its angular frequency ν, rad/s.

    Raise InputError if the mass is not positive or a friction is negative.
    """
    require_positive("servo_axis", mass_m=m)
    for name, value in (("viscous", viscous), ("dry", dry)):
        if not value >= 0:
            raise InputError(f"servo_axis: {name} friction must be >= 0, got {value}")
    axis = Axis(m, viscous / m, dry)

    def flow(u: Tensor | float, q: Tensor, p: Tensor, s: Tensor, h: Step) -> State:
        return _flow(axis, u + offset, q, p, s, h)

    return driven_scene(
        lambda q: -offset * q[..., 0],
        lambda q: torch.full_like(q, -offset),
        axis.gamma,
        amplitude,
        frequency,
        m=m,
        external=lambda q, v: -dry * torch.tanh(v / SMOOTH_WIDTH),  # noqa: ARG005
        flow=flow,
        name="servo_axis",
        description="motor axis with dry friction and sticking, no spring, in closed form between reversals",
        coordinates=("x",),
        units=("m",),
        parameters={
            "m": m, "viscous": viscous, "dry": dry, "offset": offset, "amplitude": amplitude, "frequency": frequency,
        },
        q_range=(-0.1, 0.1),
        v_range=(-0.2, 0.2),
        h=0.02,
        examples=({"m": 2.1, "viscous": 3.0, "dry": 0.7, "offset": -0.2, "amplitude": 2.0, "frequency": 2.0},),
    )  # fmt: skip


def _flow(axis: Axis, force: Tensor | float, q: Tensor, p: Tensor, s: Tensor, h: Step) -> State:
    """The motion under a constant force: slip until rest, if within h; then stick, or slip in the force's direction."""
    dtype = q.dtype
    q, p, s = (x.double() for x in (q, p, s))
    shape = torch.broadcast_shapes(q.shape[:-1], p.shape[:-1], s.shape, torch.as_tensor(h).shape)
    h = torch.as_tensor(h, dtype=q.dtype, device=q.device).expand(shape)
    F = torch.as_tensor(force, dtype=q.dtype, device=q.device).expand(shape)
    x, v, s = q[..., 0].expand(shape), (p[..., 0] / axis.m).expand(shape), s.expand(shape)
    way = torch.where(v == 0, _pushed(F, axis.dry), v.sign())
    first = torch.minimum(_time_to_rest(axis, F - way * axis.dry, v), h)
    rests = first < h
    x, v, s = _piece(axis, F, way, (x, v, s), first)
    v = torch.where(rests, 0.0, v)
    x, v, s = _piece(axis, F, torch.where(rests, _pushed(F, axis.dry), way), (x, v, s), h - first)
    return tuple(y.to(dtype) for y in (x[..., None], axis.m * v[..., None], s))  # type: ignore[return-value]


def _pushed(F: Tensor, dry: float) -> Tensor:
    """The direction in which F moves a body at rest: −1, 0 (the body sticks) or 1."""
    return torch.where(F.abs() > dry, F.sign(), 0.0)


def _time_to_rest(axis: Axis, F: Tensor, v: Tensor) -> Tensor:
    """The time at which v̇ = F/M − γv stops a body of velocity v; infinite if F does not stop the body."""
    a = F / axis.m
    brakes = (a * v < 0) & (v != 0)
    # The time without viscous friction, −v/a.
    undamped = torch.where(brakes, -v / torch.where(brakes, a, 1.0), 0.0)
    time = torch.log1p(axis.gamma * undamped) / axis.gamma if axis.gamma > 0 else undamped
    return torch.where(brakes, time, torch.inf)


def _piece(axis: Axis, F: Tensor, way: Tensor, start: State, t: Tensor) -> State:
    """Position, velocity and action after a time t of slip in the direction `way`, or of rest (way = v = 0)."""
    x, v, s = start
    rests = (way == 0) & (v == 0)
    a = torch.where(rests, 0.0, (F - way * axis.dry) / axis.m)

    def motion(t: Tensor) -> tuple[Tensor, Tensor]:
        if axis.gamma == 0:
            return x + t * (v + 0.5 * t * a), v + t * a
        # ∫ e^{−γτ} dτ from 0 to t
        damped_time = -torch.expm1(-axis.gamma * t) / axis.gamma
        return x + v * damped_time + a * (t - damped_time) / axis.gamma, v + damped_time * (a - axis.gamma * v)

    action = torch.exp(-axis.gamma * t) * s
    for node, weight in zip(NODES, WEIGHTS, strict=True):
        tau = 0.5 * t * (1.0 + node)
        y, w = motion(tau)
        rate = 0.5 * axis.m * w * w + F * y
        action = action + 0.5 * t * weight * torch.exp(-axis.gamma * (t - tau)) * rate
    return *motion(t), action
