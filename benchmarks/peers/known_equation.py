"""The floor: the true equation with a few unknown numbers, and every start, fitted by Gauss–Newton.

Pendulum: q̈ = −a sin q − b q̇. Double pendulum in the absolute angles, in units of the first arm's inertia:
M = [[1, c cos δ], [c cos δ, d]], δ = q1 − q2, gravity (a1 sin q1, a2 sin q2), viscous friction (b1, b2) at both joints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .rollouts import Flow, rk4
from .samples import Motion, Samples

STEP = 0.025  # longest Runge–Kutta step, times the motion's fastest rate
ITERATIONS = 40  # at most: a fit ends where the cost falls by less than 1e-9 of itself
WINDOWS = 120  # fitted at most
BUMP = 1e-6  # of the differences


@dataclass(frozen=True)
class Equation:
    """q̈ = f(q, q̇; θ)."""

    relative: bool  # the second coordinate is the angle between the arms

    def first_guess(self, motion: Motion) -> Tensor:
        """θ of least squares on differences: the equation is linear in it, (P,)."""
        q, v, a = (x.cumsum(-1) if self.relative else x for x in (motion.q, motion.v, motion.a))
        if q.shape[1] == 1:
            matrix, right = torch.cat([q.sin(), v], -1), -a[:, 0]
        else:
            (q1, q2), (v1, v2), (a1, a2) = q.unbind(-1), v.unbind(-1), a.unbind(-1)
            C, S, o = (q1 - q2).cos(), (q1 - q2).sin(), torch.zeros_like(q1)
            top = torch.stack([C * a2 + S * v2**2, o, q1.sin(), o, v1, v1 - v2], -1)
            low = torch.stack([C * a1 - S * v1**2, a2, o, q2.sin(), o, v2 - v1], -1)
            matrix, right = torch.cat([top, low]), torch.cat([-a1, o])
        return torch.linalg.lstsq(matrix, right[:, None], driver="gelsd").solution[:, 0]

    def acceleration(self, q: Tensor, v: Tensor, theta: Tensor) -> Tensor:
        """(B, n); θ is (B, P)."""
        if q.shape[1] == 1:
            return -theta[:, :1] * q.sin() - theta[:, 1:] * v
        if self.relative:
            q, v = q.cumsum(-1), v.cumsum(-1)
        c, d, a1, a2, b1, b2 = theta.unbind(-1)
        q1, q2, v1, v2 = *q.unbind(-1), *v.unbind(-1)
        C, S = c * (q1 - q2).cos(), c * (q1 - q2).sin()
        bend = b2 * (v2 - v1)
        f1 = -S * v2 * v2 - a1 * q1.sin() - b1 * v1 + bend
        f2 = S * v1 * v1 - a2 * q2.sin() - bend
        det = d - C * C
        a = torch.stack([(d * f1 - C * f2) / det, (f2 - C * f1) / det], -1)
        return torch.cat([a[:, :1], a[:, 1:] - a[:, :1]], -1) if self.relative else a

    def field(self, y: Tensor, theta: Tensor) -> Tensor:
        """ẏ of y = (q, v), (B, 2n); θ is (B, P) or (P,)."""
        q, v = y.chunk(2, -1)
        return torch.cat([v, self.acceleration(q, v, theta.expand(len(y), -1))], -1)


def train_known_equation(samples: Samples, seed: int, budget: float) -> Flow:  # noqa: ARG001
    """Least squares of the positions of windows, short ones first, from a linear fit of differences.

    One joint: at last every trajectory whole, gaps included. Two joints are chaotic: windows of 41 samples are last.
    """
    n, h, equation, m = samples.dof, samples.h, Equation(samples.relative), samples.motion()
    fastest = float((m.a.square().mean() / m.v.square().mean()).sqrt())
    parts = max(1, math.ceil(h * fastest / STEP))
    longest = max(len(q) for q in samples.q)
    theta = _fit_windows(equation, samples.windows(min(10, longest)), equation.first_guess(m), h, parts)
    last = samples.windows(min(41, longest))
    if samples.gaps is not None:
        last = samples.gaps[None]
    elif n == 1:
        last = torch.stack([torch.cat([q, q.new_full((longest - len(q), n), torch.nan)]) for q in samples.q])
    theta = _fit_windows(equation, last, theta, h, parts)
    return Flow(lambda y: equation.field(y, theta), h, parts, len(theta))


def _fit_windows(equation: Equation, data: Tensor, theta: Tensor, h: float, parts: int) -> Tensor:
    """θ after Levenberg–Marquardt on θ and the state at the start of each window, with central differences.

    What is NaN in the windows (W, length, n) counts as not measured.
    """
    data = data[:: max(1, len(data) // WINDOWS)]
    W, length, n = data.shape
    P, k = len(theta), 2 * n
    slope = (-1.5 * data[:, 0] + 2 * data[:, 1] - 0.5 * data[:, 2]) / h
    start, target, damping = torch.cat([data[:, 0], slope], -1), data.flatten(1), 1e-3

    def misfit(theta: Tensor, y: Tensor) -> Tensor:
        """Positions of the windows less the data, (B, length · n), for θ (B, P) and starts (B, 2n)."""
        seen = target.repeat(len(y) // W, 1)
        found = _positions(equation, theta, y, length, h, parts).flatten(1).nan_to_num(1e3, 1e3, -1e3)
        return torch.where(torch.isnan(seen), 0.0, found - seen)

    def cost(theta: Tensor, start: Tensor) -> tuple[Tensor, float]:
        r = misfit(theta.expand(W, P), start)
        return r, float(r.square().sum())

    r, value = cost(theta, start)
    for _ in range(ITERATIONS):
        x = torch.cat([theta.expand(W, P), start], -1)
        bumps = BUMP * torch.eye(P + k, dtype=x.dtype)
        moved = torch.cat([x + sign * bump for bump in bumps for sign in (1, -1)])
        ends = misfit(moved[:, :P], moved[:, P:]).reshape(P + k, 2, W, -1)
        J = ((ends[:, 0] - ends[:, 1]) / (2 * BUMP)).permute(1, 2, 0)  # (W, rows, P + k)
        A, b = J.mT @ J, (J.mT @ r[..., None])[..., 0]
        while damping < 1e8:
            by_theta, by_start = _step(A + damping * torch.diag_embed(A.diagonal(dim1=-2, dim2=-1) + 1e-12), b, P)
            tried = theta - by_theta, start - by_start
            new, new_value = cost(*tried)
            if new_value < value:
                break
            damping *= 6
        else:
            return theta
        (theta, start), gain = tried, 1 - new_value / value
        r, value, damping = new, new_value, max(damping / 5, 1e-12)
        if gain < 1e-9:
            break
    return theta


def _positions(equation: Equation, theta: Tensor, y: Tensor, length: int, h: float, parts: int) -> Tensor:
    """Positions (B, length, n) of motions with θ (B, P) from y (B, 2n)."""
    n = y.shape[1] // 2
    out = [y[:, :n]]
    for _ in range(length - 1):
        y = rk4(lambda y: equation.field(y, theta), y, h, parts)
        out.append(y[:, :n])
    return torch.stack(out, 1)


def _step(D: Tensor, b: Tensor, P: int) -> tuple[Tensor, Tensor]:
    """The step (P,) of θ, which the windows share, and of their starts, eliminated one by one (Schur complement)."""
    inner = torch.linalg.solve(D[:, P:, P:], torch.cat([D[:, P:, :P], b[:, P:, None]], -1))
    S = (D[:, :P, :P] - D[:, :P, P:] @ inner[..., :P]).sum(0)
    step = torch.linalg.solve(S, (b[:, :P] - (D[:, :P, P:] @ inner[..., P:])[..., 0]).sum(0))
    return step, inner[..., P] - inner[..., :P] @ step
