"""A kinetic term with the named features that contain velocities."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from herglotz.models.config import ModelConfig
from herglotz.models.feature_potential import Combination, sorted_features
from herglotz.models.features import Feature
from herglotz.models.jet import Jet
from herglotz.models.mass import PositionKinetic
from herglotz.models.phase import Phase
from herglotz.models.terms import Kinetic


class FeatureKinetic(nn.Module):
    """K = K of another term + h Σ_g θ_g f_g(w·q̄) ∏v: couplings of speeds, magnetic terms.

    Positive definite where the data have been: the least-squares fit does not keep it so elsewhere.
    """

    def __init__(
        self, base: Kinetic | PositionKinetic, features: Sequence[Feature], known: Sequence[Feature], dof: int
    ):
        super().__init__()
        self.base = base
        self.sum = Combination(features, known, dof)
        velocities = [tuple(sorted(p.velocities)) for p in self.sum.products]
        self.monomials = list(dict.fromkeys(velocities))
        of = [[float(own == monomial) for own in velocities] for monomial in self.monomials]
        self.register_buffer("of", torch.tensor(of, dtype=torch.float64), persistent=False)  # (monomials, A)
        self.of: Tensor

    def forward(self, phase: Phase) -> Jet:
        """Return K as a jet over (q0, q1)."""
        K = self.base(phase)
        f = self._functions(phase, 0).linear(self.of)
        for k, velocities in enumerate(self.monomials):
            K = K + _times(f.select(k), phase.velocity, velocities) * phase.h
        return K

    def mass(self, q: Tensor) -> Tensor:
        """Return the features' part of ∂²K/∂v², (..., n, n), at q (..., n)."""
        c, n = self.sum, self.sum.dof
        f = (c.ridge(q @ c.form.T, 0) * c.weights()) @ self.of.T
        out = q.new_zeros(*q.shape, n)
        for k, velocities in enumerate(self.monomials):
            if len(velocities) == 2:
                i, j = velocities
                unit = torch.zeros(n, n, dtype=q.dtype, device=q.device)
                unit[i, j] += 1.0
                unit[j, i] += 1.0
                out = out + f[..., k, None, None] * unit
        return out

    def straight(self, phase: Phase, rate: Tensor) -> Jet:
        """Return K_qq[v, v] + 2γ K_q v + γ² K of the features: the change of K along the straight line."""
        f = self._functions(phase, 0) * (rate * rate)
        w = phase.velocity.linear(self.sum.form)
        f = f + (self._functions(phase, 1) * (2 * rate) + self._functions(phase, 2) * w) * w
        f, out = f.linear(self.of), phase.velocity.select(0) * 0.0
        for k, velocities in enumerate(self.monomials):
            out = out + _times(f.select(k), phase.velocity, velocities)
        return out

    def along(self, phase: Phase, b: Tensor, y: Tensor, rate: Tensor) -> Jet:
        """Return bᵀ(K_q − K_qv v − γ K_v − K_vv y) of the features, b and y (..., n) constant; up to two velocities."""
        c, v = self.sum, phase.velocity
        f, slope = self._functions(phase, 0), self._functions(phase, 1)
        turned = (slope * (b @ c.form.T)).linear(self.of)
        drag = (slope * v.linear(c.form) + f * rate).linear(self.of)
        f, out = f.linear(self.of), v.select(0) * 0.0
        for k, velocities in enumerate(self.monomials):
            out = out + _times(turned.select(k), v, velocities)
            out = out - drag.select(k) * _derivative(v, velocities, b)
            if len(velocities) == 2:
                i, j = velocities
                out = out - f.select(k) * (b[..., i] * y[..., j] + b[..., j] * y[..., i])
        return out

    def _functions(self, phase: Phase, k: int) -> Jet:
        """Return θ times the k-th derivatives of the functions, vector-valued (..., A)."""
        c, x = self.sum, phase.mean
        x = x.linear(c.form)
        f = (c.ridge(x.value, k + j) if j <= x.order else None for j in range(1, 3))
        return x.map(c.ridge(x.value, k), *f) * c.weights()


def kinetic_term(config: ModelConfig, generator: torch.Generator) -> Kinetic | PositionKinetic | FeatureKinetic:
    """Return the K of a model: a mass, constant or of the position, and the named features with velocities."""
    n = config.dof
    mass = PositionKinetic(config, generator) if config.mass_width else Kinetic(n, config.alike, config.diagonal)
    learned, known = (sorted_features(names, config.angles)[1] for names in (config.features, config.known))
    return FeatureKinetic(mass, learned, known, n) if learned or known else mass


def _times(f: Jet, v: Jet, velocities: tuple[int, ...]) -> Jet:
    """Return the product f ∏v."""
    for i in velocities:
        f = f * v.select(i)
    return f


def _derivative(v: Jet, velocities: tuple[int, ...], b: Tensor) -> Jet:
    """Return the derivative of ∏v along b, for at most two velocities."""
    if len(velocities) == 1:
        return v.select(0) * 0.0 + b[..., velocities[0]]
    i, j = velocities
    return v.select(i) * b[..., j] + v.select(j) * b[..., i]
