"""The paper's parachute map exactly as printed: a numerical example of a map, not of a parachute (erratum E9).

The paper prints, after eq:parachute_hamiltoniam2 of its source,

    q_{k+1} = (p_{k+1} + 2λs_k)/m,    p_k = mg e^{2λq_k} / (1 − (2λ/m)(p_{k+1} + 2λs_k)),
    s_{k+1} = s_k + p_{k+1}²/2m − 2λ²s_k/m − (mg/2λ)(e^{2λq_k} − 1).

The printed H⁺ = (p_{k+1} + 2λs_k)²/2m + V(q_k) lacks the near-identity part p_{k+1}q_k + h(…): no h tends to the
identity. And s_{k+1} must have −2λ²s_k²/m: without the square the map is no contact map.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.scenes.scene import State

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
