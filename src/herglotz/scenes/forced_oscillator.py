"""The damped oscillator with a periodic force: its exact L_d(q0, q1, s0, t0, h) and flow in closed form.

L = mv²/2 − mΩ²q²/2 + f q cos(νt + φ) − γs. With the periodic motion Q(t) under the force, y = q − Q moves freely. From
m(Q̈ + γQ̇ + Ω²Q) = f cos θ, θ = νt + φ, the terms of L that are linear in y are e^{−γt} d/dt(e^{γt} m y Q̇), so that

    s = z + m y·Q̇ + W(t),    Ẇ = −γW + mQ̇²/2 − mΩ²Q²/2 + f Q cos θ,

where z is the action of the free oscillator. A shift of s by a function of (q, t) is a gauge (trap 3), and therefore

    L_d(q0, q1, s0, t0, h) = L_free(y0, y1, z0, h) + m (y1 Q̇1 − y0 Q̇0) + W1 − W0,    z0 = s0 − m y0 Q̇0 − W0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.scenes.oscillator import damped_oscillator
from herglotz.scenes.scene import Scene, State, require_positive
from herglotz.scenes.special import as_step


@dataclass(frozen=True)
class ExactForcedOscillator:
    """The exact time-dependent discrete Lagrangian of m(q̈ + γq̇ + Ω²q) = f cos(νt + φ), one coordinate.

    Step it by `herglotz.theory.TimeDependent(ExactForcedOscillator(...))`.

    Parameters
    ----------
    amplitude, frequency, phase
        f in units of force, ν > 0 in rad per unit of time, φ in rad.
    m, omega0, gamma
        Mass, undamped angular frequency Ω and damping rate γ, as of `ExactOscillator`.

    Raises
    ------
    InputError
        If m or ν is not positive, or the force drives an undamped oscillator at its own frequency, where no motion is
        periodic.
    """

    amplitude: float
    frequency: float
    phase: float = 0.0
    m: float = 1.0
    omega0: float = 1.0
    gamma: float = 0.2

    def __post_init__(self) -> None:
        require_positive("forced oscillator", mass_m=self.m, frequency=self.frequency)
        if self.omega0**2 == self.frequency**2 and self.gamma == 0:
            raise InputError(
                "forced oscillator: at resonance without damping no motion is periodic; change frequency or gamma"
            )

    @cached_property
    def free(self) -> Scene:
        """The oscillator without the force."""
        return damped_oscillator(self.m, self.omega0, self.gamma)

    def sustained(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Q(t) and Q̇(t) of the periodic motion."""
        a, b = self._amplitudes
        theta = self.frequency * t + self.phase
        cos, sin = theta.cos(), theta.sin()
        return a * cos + b * sin, self.frequency * (b * cos - a * sin)

    def gained(self, t0: Tensor, h: Tensor) -> Tensor:
        """W(t0 + h) for W(t0) = 0, the part of the periodic motion in s: ∫ e^{−γ(t1 − t)} (…) dt."""
        (a, b), nu, gamma = self._amplitudes, self.frequency, self.gamma
        # The source mQ̇²/2 − mΩ²Q²/2 + f Q cos θ is mean + C cos 2θ + D sin 2θ.
        kinetic, potential = 0.25 * self.m * nu**2, 0.25 * self.m * self.omega0**2
        mean = (kinetic - potential) * (a * a + b * b) + 0.5 * self.amplitude * a
        C = -(kinetic + potential) * (a * a - b * b) + 0.5 * self.amplitude * a
        D = -2 * (kinetic + potential) * a * b + 0.5 * self.amplitude * b
        size = gamma**2 + 4 * nu**2
        x, y = (gamma * C - 2 * nu * D) / size, (gamma * D + 2 * nu * C) / size
        decay = torch.expm1(-gamma * h)
        lasting = -decay / gamma if gamma else h

        def wave(t: Tensor) -> Tensor:
            theta = 2 * (nu * t + self.phase)
            return x * theta.cos() + y * theta.sin()

        return mean * lasting + wave(t0 + h) - (1 + decay) * wave(t0)

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, t0: Tensor, h: Tensor) -> Tensor:
        """Return L_d, shape (...)."""
        h = as_step(h, q0)
        t0 = torch.as_tensor(t0, dtype=q0.dtype, device=q0.device)
        (Q0, V0), (Q1, V1) = self.sustained(t0), self.sustained(t0 + h)
        y0, y1 = q0 - Q0[..., None], q1 - Q1[..., None]
        before, after = (self.m * (y.sum(-1) * V) for y, V in ((y0, V0), (y1, V1)))
        return self.free.L_d(y0, y1, s0 - before, h) + after - before + self.gained(t0, h)

    def flow(self, q: Tensor, p: Tensor, s: Tensor, t0: Tensor | float, h: Tensor | float) -> State:
        """(q1, p1, s1) after the time h; conjugate points are no singularities."""
        h = as_step(h, q)
        t0 = torch.as_tensor(t0, dtype=q.dtype, device=q.device)
        (Q0, V0), (Q1, V1) = ((x[..., None] for x in self.sustained(t)) for t in (t0, t0 + h))
        y, push = q - Q0, self.m * V0
        y1, py1, z1 = self.free.flow(y, p - push, s - (push * y).sum(-1), h)
        return y1 + Q1, py1 + self.m * V1, z1 + self.m * (V1 * y1).sum(-1) + self.gained(t0, h)

    def hamiltonian(self, q: Tensor, p: Tensor, s: Tensor, t: Tensor | float) -> Tensor:
        """H = p²/2m + mΩ²q²/2 − f q cos(νt + φ) + γs, (...)."""
        t = torch.as_tensor(t, dtype=q.dtype, device=q.device)
        force = self.amplitude * torch.cos(self.frequency * t + self.phase)
        return self.free.hamiltonian(q, p, s) - q.sum(-1) * force

    @cached_property
    def _amplitudes(self) -> tuple[float, float]:
        """The a and b of Q = a cos θ + b sin θ."""
        gap, drag = self.omega0**2 - self.frequency**2, self.gamma * self.frequency
        size = self.m * (gap**2 + drag**2)
        return self.amplitude * gap / size, self.amplitude * drag / size
