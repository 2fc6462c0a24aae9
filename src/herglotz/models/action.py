"""Damping that depends on s: increasing maps s ↦ s1 of the action, by a network or by powers of s."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from herglotz.models.config import POWERS, ModelConfig
from herglotz.models.jet import Jet
from herglotz.models.network import feature_count


class ActionFlow(nn.Module):
    """J maps s ↦ s + δ in turn, each the exact flow over half a step of ṡ = (r S/k) tanh(k s/S + b), called a unit.

    b = β + W·(features of q̄, v): together the units are a tanh network of (s/S, q̄, v) that adds to L. Written in
    x = k s/S + b and a = r h/2, the flow of one unit is y = asinh(eᵃ sinh x), that is

        y − x = atanh( t (e^{2a} − 1) / (1 + eᵃ D) ),    t = tanh x,   D = √(1 + (e^{2a} − 1) t²),

    whose terms are bounded for every x. The slope dy/dx = eᵃ/D is positive and runs from eᵃ at x = 0 to 1 far away. A
    composition of units therefore increases, 1 + D3 > 0 *by construction*; r has either sign, so the slope can be
    anywhere in (0, ∞). L_s = Σ r sech²(k s/S + b) rises and falls with s: damping may also decrease with s.

    The rates r start at 0, where every unit is the identity. The units are composed in one order before the kinetic
    term and in the opposite order after the kinetic term. The step is then its own adjoint, hence of order 2 for every
    weight (a network of s in the rule itself would have order 1, trap 1). Finite while |a| < 18 (float64).
    """

    def __init__(self, config: ModelConfig, generator: torch.Generator):
        super().__init__()
        J, inputs = config.action_width, feature_count(config.angles) + config.dof
        draw = lambda *shape: torch.randn(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
        # S, the natural size of s: momentum times position at mass 1.
        self.size = sum(a * b for a, b in zip(config.speed, config.scale, strict=True))
        self.rate = nn.Parameter(torch.zeros(J, dtype=torch.float64))
        self.log_slope = nn.Parameter(torch.zeros(J, dtype=torch.float64))
        self.weight = nn.Parameter(draw(J, inputs) * (0.3 / inputs**0.5))
        # The centres lie on both sides of s = 0: units with equal slopes there could not tell s from −s.
        self.bias = nn.Parameter(torch.linspace(-1.0, 1.0, J, dtype=torch.float64) + 0.1 * draw(J))

    def offsets(self, features: Jet) -> Jet:
        """Return b of every unit, vector-valued (..., J)."""
        return features.linear(self.weight, self.bias)

    def forward(self, s0: Jet, gained: Jet, offsets: Jet, h: Tensor, *, backward: bool = False) -> Jet:
        """Return the gain of s after the units of half a step, from the gain before; increments do not cancel."""
        slope, rate = self.log_slope.exp() / self.size, self.rate
        order = range(len(rate))
        for j in reversed(order) if backward else order:
            x = (s0 + gained) * slope[j] + offsets.select(j)
            gained = gained + unit_increment(x, rate[j] * h / 2) / slope[j]
        return gained


def unit_increment(x: Jet, a: Tensor) -> Jet:
    """Return asinh(eᵃ sinh x) − x as a jet; a is (...)."""
    t = x.value.tanh()
    e, E = a.exp(), torch.expm1(2 * a)
    D = (1 + E * t * t).sqrt()
    sech = 1 - t * t
    f2 = -e * E * t * sech / (D * D * D) if x.order == 2 else None
    return x.map(torch.atanh(t * E / (1 + e * D)), E * sech / (D * (e + D)), f2)


class ActionPowers(nn.Module):
    """Maps s ↦ s + δ, one after the other for every power p: L has −Σ β sᵖ.

    Each map is the exact flow of ṡ = −β sᵖ over half a step. With y = (p − 1) β (h/2) sᵖ⁻¹ the flow is
    s (1 + y)^(−1/(p − 1)), and the slope (1 + y)^(−p/(p − 1)) is positive. For y ≤ −1 the flow leaves the reals within
    the step: the result is NaN, and the step has no solution.

    The motion is damped at the rate γ + Σ p β sᵖ⁻¹. A shift of s is a gauge: a shift moves β of one power to the powers
    below, to γ and to a constant in V, which is 0 here.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        self.powers = [POWERS[name] for name in config.dissipation]
        # The flows are sorted by power, because another order of composition makes another step.
        self.order = sorted(range(len(self.powers)), key=self.powers.__getitem__)
        self.coefficient = nn.Parameter(torch.zeros(len(self.powers), dtype=torch.float64))

    def forward(self, s0: Jet, gained: Jet, offsets: Jet | None, h: Tensor, *, backward: bool = False) -> Jet:  # noqa: ARG002
        """Return the gain of s after half a step of every power, from the gain before; increments do not cancel."""
        for j in reversed(self.order) if backward else self.order:
            gained = gained + power_increment(s0 + gained, self.powers[j], self.coefficient[j] * h / 2)
        return gained


def power_increment(s: Jet, power: int, a: Tensor) -> Jet:
    """Return s (1 + y)^(−1/(p − 1)) − s with y = (p − 1) a sᵖ⁻¹ as a jet, of p = 2 or 3; a is (...)."""
    x = s.value
    if power == 2:
        # The square root is NaN where the flow leaves the reals within the step.
        root = (1 + a * x).sqrt()
        z = root * root
        return s.map(-a * x * x / z, -a * x * (1 + z) / (z * z), -2 * a / (z * z * z))
    y = 2 * a * x * x
    root = (1 + y).sqrt()
    cube = root * root * root
    f1 = -y * (root * root + root + 1) / ((1 + root) * cube)
    return s.map(-x * y / (root * (1 + root)), f1, -6 * a * x / (cube * root * root))
