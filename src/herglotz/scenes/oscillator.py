"""The damped harmonic oscillator, q̈ = −Ω²q − γq̇, free or with a periodic force: everything in closed form.

L = mv²/2 − mΩ²q²/2 − γs. With ω² = Ω² − γ²/4 (of either sign), E = e^{−γh}, S = sin(ωh)/ω, C = cos(ωh).

A periodic force adds f q cos(νt + φ) to L. With the periodic motion Q(t) under the force, y = q − Q moves freely. From
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
from herglotz.scenes.natural import Natural
from herglotz.scenes.rules import all_rules, strang
from herglotz.scenes.scene import Scene, State, Step, require_positive
from herglotz.scenes.special import as_step, cosw, sincw, versw


@dataclass(frozen=True)
class ExactOscillator:
    """The exact discrete Lagrangian of the damped oscillator.

    L_d = (E−1)s0 + (m/2S)[(E q0² + q1²) C − 2√E q0·q1] − (mγ/4)(q1² − E q0²)

    with the bracket evaluated in increments, (√E q0 − q1)² − (1 − C)(E q0² + q1²), so that small steps do not cancel.
    Isotropic in any dimension. Singular at the conjugate points ωh = π, 2π, …

    Source: section 3 of `docs/mathematics.md`.
    """

    m: float
    omega0: float
    gamma: float

    def coefficients(self, h: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """√E − 1, m/S, 1 − C and C, each of the shape of h."""
        x = (self.omega0**2 - self.gamma**2 / 4) * h**2
        return torch.expm1(-0.5 * self.gamma * h), self.m / (h * sincw(x)), versw(x), cosw(x)

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L_d, shape (...)."""
        h = as_step(h, q0)
        decay, k, versine, _ = self.coefficients(h)
        E = (1.0 + decay) ** 2
        # √E q0 − q1
        u = decay[..., None] * q0 - (q1 - q0)
        r0, r1 = E * (q0 * q0).sum(-1), (q1 * q1).sum(-1)
        quadratic = 0.5 * k * ((u * u).sum(-1) - versine * (r0 + r1)) - 0.25 * self.m * self.gamma * (r1 - r0)
        return torch.expm1(-self.gamma * h) * s0 + quadratic

    def flow(self, q: Tensor, p: Tensor, s: Tensor, h: Step) -> State:
        """(q1, p1, s1), where d/dt(s − p·q/2) = −γ(s − p·q/2) gives s1 without dividing by S at conjugate points."""
        m, gamma, omega0 = self.m, self.gamma, self.omega0
        h = as_step(h, q)
        x = (omega0**2 - gamma**2 / 4) * h**2
        C, S, root = (y[..., None] for y in (cosw(x), h * sincw(x), torch.exp(-0.5 * gamma * h)))
        q1 = root * (q * C + (p / m + 0.5 * gamma * q) * S)
        p1 = root * (p * C - (m * omega0**2 * q + 0.5 * gamma * p) * S)
        s1 = 0.5 * (p1 * q1).sum(-1) + torch.exp(-gamma * h) * (s - 0.5 * (p * q).sum(-1))
        return q1, p1, s1


def damped_oscillator(m: float = 1.0, omega0: float = 1.0, gamma: float = 0.2) -> Scene:
    """The damped harmonic oscillator q̈ = −ω₀²q − γq̇.

    Parameters
    ----------
    m, omega0
        Mass, kg, and undamped angular frequency Ω, rad/s.
    gamma
        Damping rate γ, 1/s; γ = 2Ω is critical.

    Raise InputError if m ≤ 0.

    Source: section 3 of `docs/mathematics.md`.
    """
    require_positive("damped_oscillator", mass_m=m)
    L_d = ExactOscillator(m, omega0, gamma)
    stiffness = m * omega0**2

    def potential(q: Tensor) -> Tensor:
        return 0.5 * stiffness * (q * q).sum(-1)

    system = Natural(potential, gamma, m)

    return Scene(
        name="damped_oscillator",
        description="damped harmonic oscillator, q̈ = −ω₀²q − γq̇, in closed form at any damping",
        coordinates=("q",),
        units=("m",),
        parameters={"m": m, "omega0": omega0, "gamma": gamma},
        **system.functions(),
        flow=L_d.flow,
        L_d=L_d,
        exact=True,
        L_d_rules={**all_rules(system.lagrangian), "strang": strang(potential, m, gamma)},
        q_range=(-1.5, 1.5),
        v_range=(-1.5, 1.5),
        h=0.1,
        examples=({"m": 1.7, "omega0": 1.3, "gamma": 0.6}, {"m": 0.6, "omega0": 0.7, "gamma": 3.1}),
    )


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

    Raise InputError if m or ν is not positive, or the force drives an undamped oscillator at its own frequency, where
    no motion is periodic.
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
