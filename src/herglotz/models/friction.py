"""Forces that the one scalar s cannot express (trap 4): friction of joints, between joints, and inputs."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from herglotz.errors import InputError
from herglotz.mechanics import Forces
from herglotz.models.config import ModelConfig
from herglotz.models.jet import pairs
from herglotz.models.term import Term

# The widths v_s and v_st of dry friction start at these shares of the typical speed.
START_SMOOTH_WIDTH, START_STRIBECK_WIDTH = 0.02, 0.2
# Widths are at least this share of the typical speed: else data with sticking would make a step arbitrarily stiff.
MIN_WIDTH = 0.001


class Friction(nn.Module):
    """f = −b v − (τ + ε e^{−(v/v_st)²}) tanh(v/v_s) + G (u − u₀) for each joint, F⁻ = c (h/2) f, F⁺ = (h/2) f, v = Δ/h.

    b is viscous friction, τ the Coulomb force and τ + ε the breakaway force of Stribeck's curve. The three are plain
    parameters of either sign that start at 0 (a logarithm collapses on short horizons and never comes back), so the
    data decide the sign of friction. Only the widths v_s and v_st, which cannot be 0, are logarithms above a floor.
    Both forces take f at the velocity of the step, so the step stays of order 2, and linear in q1 if friction is
    viscous alone.

    With `sticking` dry friction is set-valued, −(τ + ε e^{−(v/v_st)²}) Sgn(v) in place of the tanh, and acts in F⁻
    alone, F⁻ = c (h/2) f + c h f_dry (Moreau's implicit time-stepping). A joint stands still, Δ = 0 exactly, while an
    impulse |F⁻| ≤ c h (τ + ε) suffices to hold the joint, and the work f_dry Δ is never positive.

    The map G is learned from 0, or given; u₀ is 0, or learned: the zero of the sensors that recorded u.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        n, m = config.dof, config.inputs
        zeros = lambda *shape: torch.zeros(*shape, dtype=torch.float64)  # noqa: E731
        self.inputs, self.dry, self.sticking = m, config.coulomb, config.sticking
        self.viscous = nn.Parameter(zeros(n))
        if self.dry:
            speed = torch.tensor(config.speed, dtype=torch.float64)
            self.register_buffer("sharpest", MIN_WIDTH * speed, persistent=False)
            self.coulomb, self.breakaway = nn.Parameter(zeros(n)), nn.Parameter(zeros(n))
            if not self.sticking:
                self.log_smooth = nn.Parameter((START_SMOOTH_WIDTH * speed).log())
            self.log_stribeck = nn.Parameter((START_STRIBECK_WIDTH * speed).log())
        self.sharpest: Tensor
        self.input_map: Tensor
        if config.input_map:
            self.register_buffer("input_map", torch.tensor(config.input_map, dtype=torch.float64).reshape(n, m))
        elif m:
            self.input_map = nn.Parameter(zeros(n, m))
        self.input_zero = nn.Parameter(zeros(m)) if config.input_zero else None

    def grip(self, v: Tensor, more: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
        """Set-valued friction's |f| = (τ + more)⁺ + ε⁺ e^{−(v/v_st)²} at the velocity v, and its slope, (..., n) each.

        `more` is the part that depends on the position. Only positive parts count: negative friction would create
        energy.
        """
        width = self.sharpest + self.log_stribeck.exp()
        x = v / width
        excess = self.breakaway.relu() * (-(x * x)).exp()
        return (self.coulomb + more).relu() + excess, -2 * excess * x / width

    @property
    def widths(self) -> tuple[Tensor, Tensor]:
        """Return v_s and v_st of dry friction, (n,) each."""
        return self.sharpest + self.log_smooth.exp(), self.sharpest + self.log_stribeck.exp()

    @property
    def linear(self) -> bool:
        """Return whether f is linear in v."""
        return not self.dry

    def value_and_slope(self, v: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return f without set-valued friction, and ∂f_i/∂v_i, each (..., n); without u no input acts."""
        f, slope = -self.viscous * v, (-self.viscous).expand_as(v)
        if self.dry and not self.sticking:
            smooth, stribeck = self.widths
            x, rate = v / stribeck, 1 / smooth
            t, excess = (v * rate).tanh(), (-(x * x)).exp() * self.breakaway
            size = excess + self.coulomb
            f = f - size * t
            slope = slope - size * (1.0 - t * t) * rate + 2 * excess * x / stribeck * t
        return f if u is None else f + self.applied(u), slope

    def forward(
        self, v: Tensor, c: Tensor, h: Tensor, order: int, u: Tensor | None = None,
        more: tuple[Tensor, Tensor] | None = None,
    ) -> Forces:  # fmt: skip
        """Return F⁻ and F⁺ at the velocity v (..., n), with derivatives at order 2.

        `more` is the position-dependent part of set-valued friction at q0, (..., n), and its slope, (..., n, n).
        """
        f, slope = self.value_and_slope(v, u)
        before, after = (c * h / 2)[..., None], (h / 2)[..., None]
        minus, plus = before * f, after * f
        held, grip, grip_slope = None, None, torch.zeros_like(v)
        if self.dry and self.sticking:
            grip, grip_slope = self.grip(v, 0.0 if more is None else more[0])
            grip = (c * h)[..., None] * grip
            minus, held = minus - grip * v.sign(), torch.where(v.abs() > 0, 0.0, grip)
            grip_slope = grip_slope * v.sign()
        if order == 1:
            return Forces(minus, plus, held=held, grip=grip)
        # ∂f/∂q1 = slope / h
        minus_2 = torch.diag_embed((c / 2)[..., None] * slope - c[..., None] * grip_slope)
        minus_1 = -minus_2
        if more is not None and grip is not None:
            by_place = torch.where((self.coulomb + more[0] > 0)[..., None], more[1], 0.0)
            minus_1 = minus_1 - (c * h)[..., None, None] * v.sign()[..., None] * by_place
        plus_2 = torch.diag_embed(slope / 2)
        zero = torch.zeros_like(minus)
        return Forces(minus, plus, minus_1, minus_2, zero, -plus_2, plus_2, zero, held, grip)

    def applied(self, u: Tensor) -> Tensor:
        """Return G (u − u₀), (..., n)."""
        if not self.inputs or u.shape[-1:] != (self.inputs,):
            raise InputError(f"u needs shape (..., {self.inputs}), got {tuple(u.shape)}")
        return (u if self.input_zero is None else u - self.input_zero) @ self.input_map.T

    def offset(self) -> Tensor:
        """Return the force of inputs that are recorded as 0: −G u₀, (n,)."""
        return self.applied(self.input_map.new_zeros(self.inputs))


class CoupledFriction(Term):
    """f_i = −Σ_{j≠i} b_ij v_j with b symmetric, beside the b_ii of `Friction`: F⁻ = c (h/2) f, F⁺ = (h/2) f, v = Δ/h.

    For example, two links with angles from the vertical and viscous hinges β have b₁₁ = 2β, b₂₂ = β and b₁₂ = −β: one
    number per coordinate cannot express the last. The entries are parameters that start at 0; b may be indefinite.
    """

    def __init__(self, config: ModelConfig):
        super().__init__(config)
        self.viscous = nn.Parameter(torch.zeros(self.dof * (self.dof - 1) // 2, dtype=torch.float64))

    def matrix(self) -> Tensor:
        """Return the matrix b without its diagonal, (n, n)."""
        b = self.viscous
        i, j = pairs(self.dof, b.device)
        off = i != j
        upper = b.new_zeros(self.dof, self.dof).index_put((i[off], j[off]), b)
        return upper + upper.T

    def force(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Return f = −b v and −b."""
        b = self.matrix()
        return -v @ b, -b
