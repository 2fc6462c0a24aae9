"""Motions of the fitted baseline, as triples where there are no data.

The correction is free wherever no triple has been. It errs most in a hole of the data, near a separatrix for example,
and a rollout that crosses the hole never recovers. If q̈ᵢ = −kᵢ sin qᵢ − bᵢ cos qᵢ − γ q̇ᵢ (angles; −kᵢ qᵢ − bᵢ − γ q̇ᵢ
for others) explains the recorded triples up to an RMS of σ_b, the motions of this equation are expected to be as good
elsewhere in the range of the data: they join the objective as triples of the standard deviation σ_b. A baseline that
does not explain the data adds no triples.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.windows import Triples
from herglotz.least_squares import least_squares
from herglotz.progress import beat
from herglotz.training.baseline import Baseline

# Gauss–Newton iterations.
MAX_ITERATIONS = 12
# Phase of the fastest motion in one Runge–Kutta step, rad: an error of about 1e-10 a triple.
MAX_PHASE = 0.02
# Factor by which energy and speed may exceed those of the data.
BEYOND = 1.2
# Number of triples for each coordinate.
STARTS = 256


@dataclass(frozen=True)
class BaselineMotion:
    """The baseline's equation of motion with parameters fitted to triples of positions.

    A step of the data has `substeps` Runge–Kutta steps. `error` is the RMS of the third position that the equation
    predicts for the data's triples, in units of q.
    """

    angles: Tensor  # (n,) bool
    parameters: Tensor  # (3, n): k, b and the one rate γ, repeated
    substeps: int
    error: float = math.inf

    def triples(self, data: Trajectories, base: Baseline) -> Triples:
        """Return triples from quasi-random states in the range of the data and a little beyond."""
        recorded = data.triples(base.max_step)
        columns = [self._states(i, recorded) for i in range(data.dof)]
        count = min(len(q) for q, _ in columns)
        q1, v1 = (torch.stack([one[k][:count] for one in columns], -1) for k in (0, 1))
        like = torch.arange(count, device=q1.device) * len(recorded) // max(count, 1)
        h0, h1 = recorded.h0[like], recorded.h1[like]
        q0, q2 = (self._flow(q1, v1, h)[0] for h in (-h0, h1))
        return Triples(q0, q1, q2, h0, h1, recorded.index[like])

    def _states(self, i: int, recorded: Triples) -> tuple[Tensor, Tensor]:
        """Return positions and velocities of coordinate i with at most `BEYOND` times the energy of the data."""
        q, v = recorded.q1[:, i], recorded.v[:, i]
        low, high = float(q.min()), float(q.max())
        middle, half = (low + high) / 2, (high - low) / 2 * BEYOND**2
        half = min(half, math.pi) if self.angles[i] else half
        unit = torch.quasirandom.SobolEngine(2, seed=i, scramble=True).draw(4 * STARTS * self.angles.numel()).to(q)
        q1, v1 = middle + (2 * unit[:, 0] - 1) * half, (2 * unit[:, 1] - 1) * v.abs().max() * BEYOND
        energy, lowest = self._energy(i, q, v), self._energy(i, q, 0 * v).min()
        inside = self._energy(i, q1, v1) - lowest <= BEYOND * (energy.max() - lowest)
        return q1[inside][: STARTS * self.angles.numel()], v1[inside][: STARTS * self.angles.numel()]

    def _energy(self, i: int, q: Tensor, v: Tensor) -> Tensor:
        """Return ½v² + V of coordinate i."""
        k, b, _ = self.parameters[:, i]
        return v.square() / 2 + (b * q.sin() - k * q.cos() if self.angles[i] else k * q.square() / 2 + b * q)

    def linearised(self, t: Triples, v: Tensor) -> tuple[Tensor, Tensor, Callable[[Tensor], Tensor]]:
        """Errors r of q2 (T, n), their slopes in k, b and γ (3, T, n), and the velocity at q1 after a step of these.

        The velocity is eliminated: the motion always leads back to q0.
        """
        before, back = self._flow(t.q1, v, -t.h0, slopes=True)
        after, on = self._flow(t.q1, v, t.h1, slopes=True)
        missed = t.q0 - before
        gain = on[0] / back[0]

        def v_of(step: Tensor) -> Tensor:
            return v + (missed - (back[1:] * step[:, None]).sum(0)) / back[0]

        return after - t.q2 + gain * missed, on[1:] - gain * back[1:], v_of

    def _flow(self, q: Tensor, v: Tensor, h: Tensor, slopes: bool = False) -> tuple[Tensor, Tensor]:
        """Position (T, n) a time h (T,) later, by Runge–Kutta of order 4, and (4, T, n) or (0, T, n) slopes.

        The slopes are those in v, k, b and γ of the same coordinate: no coordinate acts on another.
        """
        (k, b, rate), angles, d = self.parameters, self.angles, (h / self.substeps)[:, None]

        def a(q: Tensor, v: Tensor) -> Tensor:
            sin, cos = torch.where(angles, q[0].sin(), q[0]), torch.where(angles, q[0].cos(), 1.0)
            own = (-k * sin - b * cos - rate * v[0])[None]
            if not slopes:
                return own
            stiffness = torch.where(angles, k * cos - b * sin, k)
            direct = torch.stack([torch.zeros_like(sin), sin, cos, v[0]])
            return torch.cat([own, -stiffness * q[1:] - rate * v[1:] - direct])

        still = q.new_zeros(4 * slopes, *q.shape)
        first = torch.cat([torch.ones_like(v)[None], still[1:]]) if slopes else still
        q, v = torch.cat([q[None], still]), torch.cat([v[None], first])
        for _ in range(self.substeps):
            beat()
            a1 = a(q, v)
            v2 = v + d / 2 * a1
            a2 = a(q + d / 2 * v, v2)
            v3 = v + d / 2 * a2
            a3 = a(q + d / 2 * v2, v3)
            v4 = v + d * a3
            a4 = a(q + d * v3, v4)
            q, v = q + d / 6 * (v + 2 * v2 + 2 * v3 + v4), v + d / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        return q[0], q[1:]


def fit_baseline_motion(data: Trajectories, base: Baseline, worst: float) -> BaselineMotion | None:
    """Fit by least squares to the triples of the data; return None where the remaining error exceeds `worst`."""
    t, n = data.triples(base.max_step), data.dof
    angles = torch.tensor(base.angles, device=data.t.device)
    parameters = t.q0.new_tensor([base.stiffness, base.tilt, (base.rate,) * n])
    fastest = max(max(v / x for v, x in zip(base.speed, base.scale, strict=True)), max(map(abs, base.stiffness)) ** 0.5)
    substeps = math.ceil(float(torch.maximum(t.h0, t.h1).max()) * fastest / MAX_PHASE)
    v, best = t.v, None
    for k in range(MAX_ITERATIONS):
        motion = BaselineMotion(angles, parameters, substeps)
        r, columns, v_of = motion.linearised(t, v)
        error = float(r.square().mean().sqrt())
        lost = not (math.isfinite(error) and bool(torch.isfinite(columns).all()))
        if lost or (best is not None and k > 3 and error > 0.5 * best.error):
            break
        best = replace(motion, error=error)
        A = torch.cat([torch.diag_embed(columns[0]), torch.diag_embed(columns[1]), columns[2][..., None]], -1)
        x = least_squares(A.flatten(0, 1).cpu(), -r.reshape(-1, 1).cpu())[:, 0].to(r)
        step = torch.stack([x[:n], x[n : 2 * n], x[2 * n].expand(n)])
        parameters, v = parameters + step, v_of(step)
    return best if best is not None and best.error <= worst else None
