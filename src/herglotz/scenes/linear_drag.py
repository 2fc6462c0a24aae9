"""Linear drag, q̈ = −γq̇: L = m|v|²/2 − γs, in closed form, analytic through γ = 0.

With φ(x) = (eˣ − 1)/x and Δ = q1 − q0, every formula divides by h φ(±γh) only.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.scenes.natural import Natural
from herglotz.scenes.rules import all_rules
from herglotz.scenes.scene import Scene, State, Step, require_positive
from herglotz.scenes.special import as_step, expm1w


@dataclass(frozen=True)
class ExactLinearDrag:
    """L_d = (E−1)s0 + m|Δ|²/(2hφ(γh)), E = e^{−γh}, in any dimension.

    Source: section 3 of `docs/mathematics.md`, where γ/(e^{γh} − 1) is 1/(hφ(γh)).
    """

    m: float
    gamma: float

    def stiffness(self, h: Tensor) -> Tensor:
        """∂²L_d/∂Δ² = m/(hφ(γh))."""
        return self.m / (h * expm1w(self.gamma * h))

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L_d, shape (...)."""
        h = as_step(h, q0)
        delta = q1 - q0
        return torch.expm1(-self.gamma * h) * s0 + 0.5 * self.stiffness(h) * (delta * delta).sum(-1)

    def flow(self, q: Tensor, p: Tensor, s: Tensor, h: Step) -> State:
        """q1 = q0 + (p0/m) hφ(−γh), p1 = E p0, s1 = E s0 + E (|p0|²/2m) hφ(−γh)."""
        m, gamma = self.m, self.gamma
        h = as_step(h, q)
        span, E = h * expm1w(-gamma * h), torch.exp(-gamma * h)
        return q + p / m * span[..., None], p * E[..., None], E * (s + (p * p).sum(-1) / (2 * m) * span)


def linear_drag(m: float = 1.0, gamma: float = 0.2) -> Scene:
    """A body in a viscous medium, q̈ = −γq̇.

    Parameters
    ----------
    m
        Mass, kg.
    gamma
        Damping rate γ, 1/s, of either sign or 0.

    Raise InputError if m ≤ 0.

    Source: section 3 of `docs/mathematics.md`.
    """
    require_positive("linear_drag", mass_m=m)
    L_d = ExactLinearDrag(m, gamma)
    system = Natural(lambda q: torch.zeros_like(q[..., 0]), gamma, m)

    return Scene(
        name="linear_drag",
        description="linear drag, q̈ = −γq̇, in closed form",
        coordinates=("q",),
        units=("m",),
        parameters={"m": m, "gamma": gamma},
        **system.functions(),
        flow=L_d.flow,
        L_d=L_d,
        exact=True,
        L_d_rules=all_rules(system.lagrangian),
        q_range=(-1.0, 1.0),
        v_range=(-1.0, 1.0),
        h=0.1,
        examples=({"m": 1.7, "gamma": 0.6}, {"m": 0.6, "gamma": 0.0}),
    )
