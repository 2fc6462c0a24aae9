"""The correction of the rule of order 2 to order 4, from V and K alone, without further parameters.

Between q0 and q1 the motion leaves the straight line by δ(τ) = a (τ² − h²/4)/2, |τ| ≤ h/2. With
e = L_q − L_vq v − γ L_v at (q̄, v) and M = L_vv, the action of L = K − V − γ s is, to O(h⁵),

    L_d = (c − 1) s0 + √c ( h K + h³/24 (K_qq[v, v] + 2γ K_q v + γ² K − eᵀM⁻¹e) ) − h/6 (c V0 + 4 √c V(q̄) + V1),

the integral along the straight line (Simpson's rule for V) plus the gain of the deviation δ. With c = 1, a constant
mass and V alone L_d is the force-gradient action of M. Takahashi and M. Imada, J. Phys. Soc. Jpn. 53 (1984) 3765.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.models.feature_potential import FeaturePotential
from herglotz.models.jet import Jet, of_mean, pairs
from herglotz.models.terms import FeatureKinetic, Kinetic, Phase


class Slope:
    """The force e and the mass M at one (q̄, v), for V and K made of features and a constant mass; γ is a scalar."""

    def __init__(self, potential: FeaturePotential, kinetic: Kinetic | FeatureKinetic, rate: Tensor, phase: Phase):
        self.potential, self.rate, self.phase = potential, rate, phase
        self.features = kinetic if isinstance(kinetic, FeatureKinetic) else None
        base = kinetic.base if isinstance(kinetic, FeatureKinetic) else kinetic
        # ModelConfig refuses other masses at order 4.
        assert isinstance(base, Kinetic)
        self.constant = base.mass()
        e = self._force()
        self.mass = self.constant.expand(*phase.q0.shape, phase.q0.shape[-1])
        if self.features is not None:
            self.mass = self.mass + self.features.mass(phase.mean.value)
        self.y = solve(self.mass, e)

    def gain(self) -> Jet:
        """The jet of eᵀM⁻¹e = max_y 2yᵀe − yᵀMy.

        At the constant y = M⁻¹e the second derivative is (2yᵀe − yᵀMy)″ + 2 EᵀM⁻¹E, where E has the columns
        ∂_i(e − My). Only the features' derivatives along y are needed.
        """
        y = self.y
        out = self._along(self.phase, y, y / 2) * 2.0
        if out.order == 1:
            return out
        E = self._slope(y)
        second = 2 * E.transpose(-1, -2) @ solve(self.mass, E)
        i, j = pairs(out.tangents, y.device)
        rows = second.flatten(-2)[..., i * out.tangents + j].movedim(-1, 0)
        return Jet(torch.cat([out.data[: 1 + out.tangents], out.data[1 + out.tangents :] + rows]), out.tangents, 2)

    def _along(self, phase: Phase, b: Tensor, y: Tensor) -> Jet:
        """The scalar bᵀ(e − M y) as a jet over (q0, q1), for constant b and y, (..., n)."""
        bm = b @ self.constant
        out = -of_mean(self.potential(phase.mean.value, phase.order, b))
        out = out - (phase.velocity * bm).sum() * self.rate - (bm * y).sum(-1)
        return out if self.features is None else out + self.features.along(phase, b, y, self.rate)

    def _force(self) -> Tensor:
        """The force e, (..., n)."""
        _, slope = self.potential.value_and_slope(self.phase.mean.value)
        e = -slope - self.rate * (self.phase.velocity.value @ self.constant)
        if self.features is None:
            return e
        y = torch.zeros_like(e)
        return e + self.features.along(*self._copies(y, 0), self.rate).value.movedim(0, -1)

    def _slope(self, y: Tensor) -> Tensor:
        """The derivatives of e − M y along (q0, q1) for a constant y, (..., n, 2n)."""
        if self.features is not None:
            return self._along(*self._copies(y, 1)).gradient.movedim((1, 0), (-2, -1))
        V_qq = self.potential(self.phase.mean.value, 2).hessian().movedim((0, 1), (-2, -1)) / 2
        drag = self.rate * self.constant / self.phase.h[..., None, None]
        return torch.cat([drag - V_qq, -drag - V_qq], -1)

    def _copies(self, y: Tensor, order: int) -> tuple[Phase, Tensor, Tensor]:
        """Return n copies of (q0, q1) and y, (n, ...), and the n unit vectors b, for all of e − M y at once."""
        p, n = self.phase, self.phase.q0.shape[-1]
        delta = None if p.delta is None else p.delta.expand(n, *p.q0.shape)
        h = p.h.expand(n, *p.q0.shape[:-1])
        unit = torch.eye(n, dtype=y.dtype, device=y.device).reshape(n, *(1,) * (y.ndim - 1), n)
        phase = Phase(p.q0.expand(n, *p.q0.shape), p.q1.expand(n, *p.q1.shape), h, order, p.sizes, delta)
        return phase, unit.expand(n, *y.shape), y.expand(n, *y.shape)


def missing(slope: Slope, V0: Jet, V1: Jet, root: Tensor) -> Jet:
    """The exact L_d minus √c K − h/2 (c V0 + V1), to O(h⁵), as a jet over (q0, q1); `root` is √c."""
    phase, rate = slope.phase, slope.rate
    h = phase.h
    v = phase.velocity
    inner = (v.linear(slope.constant) * v).sum() * (rate * rate / 2) - slope.gain()
    if slope.features is not None:
        inner = inner + slope.features.straight(phase, rate)
    middle = of_mean(slope.potential(phase.mean.value, phase.order))
    return inner * (root * h**3 / 24) + (V0 * (root * root) + V1 - middle * (2 * root)) * (h / 3)


def solve(matrix: Tensor, b: Tensor) -> Tensor:
    """M⁻¹ b for b (..., n) or (..., n, k)."""
    n = matrix.shape[-1]
    vector = b.ndim < matrix.ndim
    x = b[..., None] if vector else b
    if n == 1:
        x = x / matrix
    elif n == 2:
        p, q, r, s = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
        adjugate = torch.stack([torch.stack([s, -q], -1), torch.stack([-r, p], -1)], -2)
        x = adjugate @ x / (p * s - q * r)[..., None, None]
    else:
        # The inverse, because torch's forward-mode derivative of a solve is wrong under vmap.
        x = torch.linalg.inv_ex(matrix)[0] @ x
    return x[..., 0] if vector else x
