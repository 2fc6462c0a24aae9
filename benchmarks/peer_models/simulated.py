"""Simulated data sets: exact velocities exist, and the truth has no noise."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from herglotz.data import simulate
from herglotz.scenes import scene

from .judging import Metrics, Problem, errors
from .known_equation import Equation
from .rollouts import Predictor, rk4
from .samples import Motion, Samples

STEPS = 100


def _middle(q: Tensor, h: float) -> tuple[Tensor, Tensor]:
    return q[:, 1:-1], (q[:, 2:] - q[:, :-2]) / (2 * h)


def _pendulum_motion(q: Tensor, clean: Tensor, v: Tensor, gamma: float) -> tuple[Motion, ...]:
    """The positions given, with the rates at the positions without noise."""
    a = -clean.sin() - gamma * v
    return tuple(Motion(q_i, v_i, v_i, a_i, a_i) for q_i, v_i, a_i in zip(q, v, a, strict=True))


def pendulum(h: float, noise: float = 0.0, trajectories: int = 40) -> Problem:
    """The damped pendulum: 40 × 41 positions; 5 × 20 unseen starts, 100 steps."""
    system, gamma = scene("damped_pendulum"), 0.2

    def samples(seed: int, exact: bool) -> Samples:
        options = {"trajectories": trajectories, "steps": 40, "h": h, "seed": seed, "keep_state": True}
        data = simulate(system, noise=noise, **options)
        q = data.q.reshape(trajectories, 41, 1)
        if not exact:
            return Samples(tuple(q), h, (True,), noise > 0)
        clean = simulate(system, **options)  # the noise is drawn last: these are the same motions
        assert clean.p is not None
        motion = _pendulum_motion(q, clean.q.reshape(q.shape), clean.p.reshape(q.shape), gamma)
        return Samples(tuple(q), h, (True,), noise > 0, motion)

    def tests() -> tuple[Tensor, Tensor]:
        options = {"trajectories": 20, "steps": STEPS + 1, "h": h, "keep_state": True}
        sets = [simulate(system, seed=k, **options) for k in range(1000, 1005)]
        q, p = (torch.cat([getattr(one, name) for one in sets]) for name in "qp")
        return q.reshape(-1, STEPS + 2, 1), p.reshape(-1, STEPS + 2, 1)

    what = f"{trajectories} × 41 positions, h = {h:g}" + (f", noise {noise:g} rad" if noise else "")
    return _pendulum_problem(h, samples, tests, what)


def one_pendulum(h: float = 0.5) -> Problem:
    """One trajectory of 41 positions from v = 0; unseen starts are those with less energy than it begins with."""
    system, gamma = scene("damped_pendulum"), 0.2

    def run(seed: int) -> tuple[Tensor, Tensor]:
        angle = 2.0 + 0.1 * seed  # released from rest
        data = simulate(system, trajectories=1, steps=40, h=h, seed=seed, q_range=(angle, angle), v_range=(0.0, 0.0),
                        keep_state=True)  # fmt: skip
        assert data.p is not None
        return data.q[None], data.p[None]

    def samples(seed: int, exact: bool) -> Samples:
        q, v = run(seed)
        return Samples(tuple(q), h, (True,), False, _pendulum_motion(q, q, v, gamma) if exact else None)

    def tests() -> tuple[Tensor, Tensor]:
        # Inside every seed's range: energy below that of the release at 2 rad.
        data = simulate(system, trajectories=200, steps=STEPS + 1, h=h, seed=1000, q_range=(-2.0, 2.0),
                        v_range=(-1.68, 1.68), keep_state=True)  # fmt: skip
        assert data.p is not None
        q, p = (x.reshape(200, STEPS + 2, 1) for x in (data.q, data.p))
        inside = (p[:, 0, 0].square() / 2 + 1 - q[:, 0, 0].cos() < 1 - math.cos(2.0)).nonzero()[:100, 0]
        return q[inside], p[inside]

    return _pendulum_problem(h, samples, tests, f"one trajectory of 41 positions, h = {h:g}")


def _pendulum_problem(h: float, samples: Any, tests: Any, what: str) -> Problem:
    def energy(q: Tensor) -> Tensor:
        q, v = _middle(q, h)
        return (v.square() / 2 + 1 - q.cos())[..., 0]

    def judge(model: Predictor, exact: bool) -> Metrics:
        q, v = tests()
        state = torch.cat([q[:, 1], v[:, 1]], -1) if exact else None
        return errors(model.rollout(q[:, 0], q[:, 1], STEPS, state), q, energy)

    return Problem(f"damped pendulum, {what}; {STEPS} steps from 100 unseen starts", samples, judge)


# m = ℓ = 1, g = 9.81, viscous 0.1 at both joints, over the first arm's inertia 2: see `known_equation`.
DOUBLE = torch.tensor([[0.5, 0.5, 9.81, 4.905, 0.05, 0.05]], dtype=torch.float64)


def double_motion(q: Tensor, v: Tensor, h: float, samples: int) -> tuple[Tensor, Tensor]:
    """Positions and velocities (B, samples, 2) in the joint angles (θ1, θ2 − θ1), by short Runge–Kutta steps."""
    equation, y = Equation(relative=True), torch.cat([q, v], -1)

    def field(y: Tensor) -> Tensor:
        return torch.cat([y[:, 2:], equation.acceleration(y[:, :2], y[:, 2:], DOUBLE.expand(len(y), -1))], -1)

    out = [y]
    for _ in range(samples - 1):
        y = rk4(field, y, h, 24)
        out.append(y)
    both = torch.stack(out, 1)
    return both[..., :2], both[..., 2:]


def double_momentum(q: Tensor, v: Tensor) -> Tensor:
    """Momentum ∂L/∂v of the joint angles, (..., 2)."""
    (w1, w2), C = v.cumsum(-1).unbind(-1), q[..., 1].cos()
    p1, p2 = 2 * w1 + C * w2, C * w1 + w2
    return torch.stack([p1 + p2, p2], -1)


def double_pendulum(h: float = 0.02, steps: int = 50) -> Problem:
    """100 × 100 positions of both joint angles, released from rest within ±1 rad; 50 steps from 100 unseen releases."""

    def runs(seed: int, samples: int) -> tuple[Tensor, Tensor]:
        make = torch.Generator().manual_seed(seed)
        q = 2.0 * torch.rand(100, 2, generator=make, dtype=torch.float64) - 1.0
        return double_motion(q, torch.zeros_like(q), h, samples)

    def samples(seed: int, exact: bool) -> Samples:
        q, v = runs(seed, 100)
        if not exact:
            return Samples(tuple(q), h, (True, True))
        flat_q, flat_v = (x.reshape(-1, 2).requires_grad_() for x in (q, v))
        p = double_momentum(flat_q, flat_v)
        with torch.no_grad():
            a = Equation(relative=True).acceleration(flat_q, flat_v, DOUBLE.expand(len(flat_q), -1))
        slopes = [torch.autograd.grad(p[:, i].sum(), (flat_q, flat_v), retain_graph=True) for i in (0, 1)]
        f = torch.stack([(p_q * flat_v + p_v * a).sum(-1) for p_q, p_v in slopes], -1)  # ṗ by the chain rule
        parts = (x.detach().reshape(q.shape) for x in (flat_q, flat_v, p, a, f))
        return Samples(tuple(q), h, (True, True), False, tuple(Motion(*x) for x in zip(*parts, strict=True)))

    def energy(q: Tensor) -> Tensor:
        q, v = _middle(q, h)
        q = q.cumsum(-1)
        drop = 1 - q.cos()
        w = v.cumsum(-1)
        kinetic = w[..., 0] ** 2 + w[..., 1] ** 2 / 2 + w[..., 0] * w[..., 1] * (q[..., 0] - q[..., 1]).cos()
        return kinetic + 9.81 * (2 * drop[..., 0] + drop[..., 1])

    def judge(model: Predictor, exact: bool) -> Metrics:
        q, v = runs(1000, steps + 2)
        second = double_momentum(q[:, 1], v[:, 1]) if getattr(model, "momentum", False) else v[:, 1]
        state = torch.cat([q[:, 1], second], -1) if exact else None
        return errors(model.rollout(q[:, 0], q[:, 1], steps, state), q, energy)

    title = f"double pendulum, friction at both joints, 100 × 100 positions, h = {h:g}; {steps} steps from 100 releases"
    return Problem(title, samples, judge, relative=True, dof=2)
