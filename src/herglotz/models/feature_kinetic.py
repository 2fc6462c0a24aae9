"""A kinetic term with the named features that contain velocities."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor, nn

from herglotz.models.config import ModelConfig
from herglotz.models.feature_potential import Combination, sorted_features
from herglotz.models.features import Feature
from herglotz.models.jet import Jet, coordinates, of_mean_and_velocity
from herglotz.models.mass import PositionKinetic
from herglotz.models.phase import Phase
from herglotz.models.terms import Kinetic


class FeatureKinetic(nn.Module):
    """K = K of `base` + h Σ_g θ_g f_g(w·q̄) ∏v: couplings of speeds, magnetic terms.

    A fit makes the mass positive definite where there are data, not elsewhere.
    """

    def __init__(
        self, base: Kinetic | PositionKinetic, features: Sequence[Feature], known: Sequence[Feature], dof: int
    ):
        super().__init__()
        self.base = base
        self.sum = Combination(features, known, dof)
        velocities = [tuple(sorted(p.velocities)) for p in self.sum.products]
        self.monomials = list(dict.fromkeys(velocities))
        # The row of a product has 1 at its monomial of velocities.
        of = [[float(own == monomial) for monomial in self.monomials] for own in velocities]
        self.register_buffer("of", torch.tensor(of, dtype=torch.float64), persistent=False)
        self.of: Tensor  # (A, monomials)

    def forward(self, phase: Phase) -> Jet:
        """Return K as a jet over (q0, q1)."""
        K, v = self.base(phase), coordinates(phase.velocity.value, phase.order)
        return K + self._summed(phase, {0: self._each([_times(v, of) for of in self.monomials])}) * phase.h

    def mass(self, q: Tensor) -> Tensor:
        """Return the features' part of ∂²K/∂v², (..., n, n), at q (..., n)."""
        c, n = self.sum, self.sum.dof
        f = (c.value(q, c.ridge(c.forms(q), 0)) * c.weights()) @ self.of
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
        """Return K_qq[v, v] + 2γ K_q v + γ² K of the features, the change of K along the straight line."""
        v = coordinates(phase.velocity.value, phase.order)
        P, w = self._each([_times(v, of) for of in self.monomials]), v.linear(self.sum.form)
        Pw = P * w
        return self._summed(phase, {0: P * (rate * rate), 1: Pw * (2 * rate), 2: Pw * w})

    def along(self, phase: Phase, b: Tensor, y: Tensor, rate: Tensor) -> Jet:
        """Return bᵀ(K_q − K_qv v − γ K_v − K_vv y) of the features, b and y (..., n) constant; up to two velocities."""
        v, form = coordinates(phase.velocity.value, phase.order), self.sum.form
        P = self._each([_times(v, of) for of in self.monomials])
        by_b = self._each([_derivative(v, of, b) for of in self.monomials])
        twice = torch.stack([_second(of, b, y) for of in self.monomials], -1) @ self.of.T
        return self._summed(phase, {1: P * (b @ form.T) - by_b * v.linear(form), 0: by_b * -rate - twice})

    def _each(self, monomials: list[Jet]) -> Jet:
        """Return the scalar jet of each product's monomial, as a jet (..., A)."""
        first = monomials[0]
        return Jet(torch.stack([m.data for m in monomials], -1) @ self.of.T, first.tangents, first.order)

    def _summed(self, phase: Phase, by_order: dict[int, Jet]) -> Jet:
        """Return Σ_g θ_g Σ_k f_g⁽ᵏ⁾(w_g·q̄) R_k,g(v) over (q0, q1), for jets R_k over v, (..., A), by k.

        Each f is a function of one number, so its derivatives are f′ w and f″ w wᵀ and no jets are multiplied.
        """
        c, order, q = self.sum, phase.order, phase.mean.value
        weights, x = c.weights(), c.forms(q)
        f = [c.ridge(x, k) * weights for k in range(max(by_order) + order + 1)]
        # The sums over k of the j-th derivatives of f times a part of R.
        total = lambda j, part: reduce(torch.add, [f[k + j] * part(R) for k, R in by_order.items()])  # noqa: E731
        values = [total(j, lambda R: R.value) for j in range(order + 1)]
        value = c.value(q, values[0]).sum(-1)
        if not order:
            return Jet(value[None], 0, 0)
        slopes = [total(j, lambda R: R.gradient) for j in range(order)]
        by_q, by_v = c.slope(q, *values[:2]), c.value(q, slopes[0]).sum(-1)
        second = None
        if order == 2:
            by_qq, by_vq = c.bend(q, *values).movedim(-1, 0), c.slope(q, *slopes).movedim(-1, 1)
            second = by_qq, by_vq, c.value(q, total(0, lambda R: R.second)).sum(-1)
        return of_mean_and_velocity(value, by_q.movedim(-1, 0), by_v, second, phase.h)


def kinetic_term(config: ModelConfig, generator: torch.Generator) -> Kinetic | PositionKinetic | FeatureKinetic:
    """Return the K of a model: a constant or position-dependent mass, and the named features with velocities."""
    n = config.dof
    mass = PositionKinetic(config, generator) if config.mass_width else Kinetic(n, config.alike, config.diagonal)
    learned, known = (sorted_features(names, config.angles)[1] for names in (config.features, config.known))
    return FeatureKinetic(mass, learned, known, n) if learned or known else mass


def _times(v: Jet, velocities: tuple[int, ...]) -> Jet:
    """Return the product ∏v."""
    product = v.select(velocities[0])
    for i in velocities[1:]:
        product = product * v.select(i)
    return product


def _derivative(v: Jet, velocities: tuple[int, ...], b: Tensor) -> Jet:
    """Return the derivative of ∏v along b, for at most two velocities."""
    if len(velocities) == 1:
        return v.select(0) * 0.0 + b[..., velocities[0]]
    i, j = velocities
    return v.select(i) * b[..., j] + v.select(j) * b[..., i]


def _second(velocities: tuple[int, ...], b: Tensor, y: Tensor) -> Tensor:
    """Return the second derivative of ∏v along b and y, for at most two velocities."""
    if len(velocities) == 1:
        return torch.zeros_like(b[..., 0])
    i, j = velocities
    return b[..., i] * y[..., j] + b[..., j] * y[..., i]
