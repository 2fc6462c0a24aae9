"""Vertical fall with quadratic drag, q̈ = λq̇² − g (q upwards, λ > 0 while falling): closed form.

L = mv²/2 − V + 2λvs with V = (mg/2λ)(e^{2λq} − 1), so p = mv + 2λs and H = (p − 2λs)²/2m + V, with the sign corrected
by erratum E9. The formulas use ω² = λg, S = sinh(ωh)/ω, C = cosh(ωh), t = tanh(ωh/2)/(ωh/2) and Δ = q1 − q0. S, C and t
are analytic in λg, so g = 0 (quadratic drag alone) needs no formulas of its own.

`PrintedParachute` is the paper's map exactly as printed: a numerical example of a map, not of a parachute (erratum E9).
The paper prints, after eq:parachute_hamiltoniam2 of its source,

    q_{k+1} = (p_{k+1} + 2λs_k)/m,    p_k = mg e^{2λq_k} / (1 − (2λ/m)(p_{k+1} + 2λs_k)),
    s_{k+1} = s_k + p_{k+1}²/2m − 2λ²s_k/m − (mg/2λ)(e^{2λq_k} − 1).

The printed H⁺ = (p_{k+1} + 2λs_k)²/2m + V(q_k) lacks the near-identity part p_{k+1}q_k + h(…): no h tends to the
identity. And s_{k+1} must have −2λ²s_k²/m: without the square the map is no contact map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.scenes.rules import all_rules
from herglotz.scenes.scene import Scene, State, Step, require_positive
from herglotz.scenes.special import as_step, cosw, sincw, versw


@dataclass(frozen=True)
class ExactParachute:
    """The exact discrete Lagrangian of the parachute, one degree of freedom, with L, H and the flow.

    L_d = (e^{2λΔ}−1)s0 + (m/2λ²S)[(1+e^{2λΔ})C − 2e^{λΔ}] − (mgh/2λ)e^{2λq1}
        = (e^{2λΔ}−1)s0 + (m/2λ²S)(e^{λΔ}−1)² + (mgh/2λ)[(t−1) + (t/2)(e^{2λΔ}−1) − (e^{2λq1}−1)]

    The code evaluates the second line, whose terms stay finite as λ → 0.

    Source: section 3 of `docs/mathematics.md`.
    """

    m: float
    g: float
    lam: float

    def coefficients(self, h: Tensor) -> tuple[Tensor, Tensor]:
        """S = sinh(ωh)/ω and t = tanh(ωh/2)/(ωh/2), each of the shape of h."""
        x = -self.lam * self.g * h**2
        return h * sincw(x), sincw(0.25 * x) / cosw(0.25 * x)

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L_d, shape (...)."""
        h = as_step(h, q0)
        m, g, lam = self.m, self.g, self.lam
        S, t = self.coefficients(h)
        q1, delta = q1[..., 0], (q1 - q0)[..., 0]
        D3 = torch.expm1(2 * lam * delta)
        kinetic = m / (2 * lam**2 * S) * torch.expm1(lam * delta) ** 2
        gravity = m * g * h / (2 * lam) * ((t - 1.0) + 0.5 * t * D3 - torch.expm1(2 * lam * q1))
        return D3 * s0 + kinetic + gravity

    def potential(self, q: Tensor) -> Tensor:
        """V = (mg/2λ)(e^{2λq} − 1), (...)."""
        return self.m * self.g / (2 * self.lam) * torch.expm1(2 * self.lam * q[..., 0])

    def lagrangian(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        """L, (...)."""
        return 0.5 * self.m * v[..., 0] ** 2 - self.potential(q) + 2 * self.lam * v[..., 0] * s

    def hamiltonian(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """H, (...)."""
        return (p[..., 0] - 2 * self.lam * s) ** 2 / (2 * self.m) + self.potential(q)

    def momentum(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:  # noqa: ARG002
        """P = L_v, (..., 1)."""
        return self.m * v + 2 * self.lam * s[..., None]

    def velocity(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:  # noqa: ARG002
        """V = H_p, (..., 1)."""
        return (p - 2 * self.lam * s[..., None]) / self.m

    def flow(self, q: Tensor, p: Tensor, s: Tensor, h: Step) -> State:
        """q1 = q0 − ln(C − λv0 S)/λ, v1 = (v0 C − g S)/(C − λv0 S); NaN if the motion is infinite before h."""
        g, lam = self.g, self.lam
        h = as_step(h, q)
        v = self.velocity(q, p, s)
        x = -lam * g * h**2
        S, C_less_1 = (h * sincw(x))[..., None], -versw(x)[..., None]
        w = C_less_1 - lam * v * S
        q1 = q - torch.log1p(w) / lam
        v1 = (v * (1.0 + C_less_1) - g * S) / (1.0 + w)
        s1 = s + self(q, q1, s, h)
        return q1, self.momentum(q1, v1, s1), s1

    def strang_exponential(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """L_d = (e^{2λΔ}−1)(s0 − hV0/2) + (m/2λ²h)(e^{λΔ}−1)² − (h/2)(V0+V1): order 2, explicit, c = e^{2λΔ}."""
        m, lam = self.m, self.lam
        h = as_step(h, q0)
        V0, V1, delta = self.potential(q0), self.potential(q1), (q1 - q0)[..., 0]
        kinetic = m / (2 * lam**2 * h) * torch.expm1(lam * delta) ** 2
        return torch.expm1(2 * lam * delta) * (s0 - 0.5 * h * V0) + kinetic - 0.5 * h * (V0 + V1)


def parachute(m: float = 1.0, g: float = 10.0, lam: float = 0.01) -> Scene:
    """Fall with quadratic drag, q̈ = λq̇² − g.

    Parameters
    ----------
    m, g
        Mass, kg, and gravity, m/s²; 0 leaves quadratic drag alone.
    lam
        Drag λ, 1/m, not 0; positive brakes downward motion.

    Raise InputError if m ≤ 0 or lam = 0.

    Source: section 3 and erratum E9 of `docs/mathematics.md`.
    """
    require_positive("parachute", mass_m=m)
    if lam == 0:
        raise InputError(f"parachute: drag lam must not be 0, got {lam}; without drag use a value such as 1e-6")
    L_d = ExactParachute(m, g, lam)

    return Scene(
        name="parachute",
        description="fall with quadratic drag, q̈ = λq̇² − g, in closed form; damping depends on the motion",
        coordinates=("q",),
        units=("m",),
        parameters={"m": m, "g": g, "lam": lam},
        hamiltonian=L_d.hamiltonian,
        lagrangian=L_d.lagrangian,
        momentum=L_d.momentum,
        velocity=L_d.velocity,
        flow=L_d.flow,
        L_d=L_d,
        exact=True,
        L_d_rules={**all_rules(L_d.lagrangian), "strang_exponential": L_d.strang_exponential},
        q_range=(50.0, 150.0),
        v_range=(-20.0, 5.0),
        h=0.1,
        examples=({"m": 1.4, "g": 7.0, "lam": 0.012},),
    )


def quadratic_drag(m: float = 1.0, lam: float = 0.01) -> Scene:
    """Motion with quadratic drag and no gravity, q̈ = λq̇²: the parachute's formulas, analytic in λg, at g = 0.

    L = mv²/2 + 2λvs, H = (p − 2λs)²/2m, L_d = (e^{2λΔ}−1)s0 + (m/2λ²h)(e^{λΔ}−1)². The drag brakes where λq̇ < 0 and
    accelerates without bound where λq̇ > 0: q1 = q0 − ln(1 − λv0h)/λ exists until λv0h = 1.

    Parameters
    ----------
    m
        Mass, kg.
    lam
        Drag λ, 1/m, not 0; positive brakes motion to negative q.

    Raise InputError if m ≤ 0 or lam = 0.

    Source: section 3 of `docs/mathematics.md`.
    """
    require_positive("quadratic_drag", mass_m=m)
    if lam == 0:
        raise InputError(f"quadratic_drag: drag lam must not be 0, got {lam}; without drag use a value such as 1e-6")
    return replace(
        parachute(m, 0.0, lam),
        name="quadratic_drag",
        description="quadratic drag without gravity, q̈ = λq̇², in closed form",
        parameters={"m": m, "lam": lam},
        q_range=(-50.0, 50.0),
        v_range=(-20.0, -1.0) if lam > 0 else (1.0, 20.0),
        examples=({"m": 1.4, "lam": 0.03}, {"m": 0.7, "lam": -0.02}),
    )


MAP_START = (100.0, 1.0, 1.0)  # (q, p, s), section 4 of the paper


@dataclass(frozen=True)
class PrintedParachute:
    """The printed map Φ̃, with the paper's λ = −0.01, m = 1, g = 10 as defaults; the paper gives no units.

    With `squared` the third line has s_k², as the printed H⁺ demands.
    """

    m: float = 1.0
    g: float = 10.0
    lam: float = -0.01
    squared: bool = False

    def H_plus(self, q0: Tensor, p1: Tensor, s0: Tensor, h: Tensor | float = 1.0) -> Tensor:  # noqa: ARG002
        """The printed H⁺, shape (...), which does not contain h."""
        kinetic = (p1[..., 0] + 2 * self.lam * s0) ** 2 / (2 * self.m)
        return kinetic + self.potential(q0)

    def potential(self, q: Tensor) -> Tensor:
        """V = (mg/2λ)(e^{2λq} − 1), shape (...)."""
        return self.m * self.g / (2 * self.lam) * torch.expm1(2 * self.lam * q[..., 0])

    def __call__(self, q: Tensor, p: Tensor, s: Tensor) -> State:
        """(q_{k+1}, p_{k+1}, s_{k+1}), the second line solved for p_{k+1}."""
        m, g, lam = self.m, self.g, self.lam
        q1 = (1.0 - m * g * torch.exp(2 * lam * q) / p) / (2 * lam)
        p1 = m * q1 - 2 * lam * s[..., None]
        s_term = s * s if self.squared else s
        s1 = s + (p1 * p1)[..., 0] / (2 * m) - 2 * lam**2 * s_term / m - self.potential(q)
        return q1, p1, s1

    def orbit(self, q: Tensor, p: Tensor, s: Tensor, steps: int) -> tuple[State, int]:
        """(q, p, s) of K + 1 points along the first axis, and the number of first steps that are finite everywhere."""
        points = [(q, p, s)]
        for _ in range(steps):
            points.append(self(*points[-1]))
        finite = [all(bool(torch.isfinite(x).all()) for x in point) for point in points]
        last = len(finite) - 1 if all(finite) else finite.index(False) - 1
        q, p, s = (torch.stack(x) for x in zip(*points, strict=True))
        return (q, p, s), last
