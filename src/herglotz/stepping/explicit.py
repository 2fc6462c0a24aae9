"""The step in closed form where the terms of a model allow it: damped leapfrog, no iteration.

With a constant mass m, a potential V, a single damping rate (c = e^{−γh}, or 1) and, at the forced level, viscous
friction b and inputs w = G u, the step equation D1 + c p0 + F⁻ = 0 is linear in Δ = q1 − q0:

    r  = p0 − h/2 (V′(q0) − w),       (m + √c h/2 b) Δ  =  h √c r,       q1 = q0 + Δ,
    p1 = c r − (1 + c)/2 b Δ − h/2 (V′(q1) − w),
    s1 = s0 + (c − 1) s0 + c/2 Δ·(r − b Δ/2) − h/2 (c V(q0) + V(q1)).

V(q1) and V′(q1) start the next step, so a rollout evaluates the potential once per step. Δ is computed without a
difference of positions, so no digits cancel when h is small.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian
from herglotz.mechanics.contact import join
from herglotz.models import ContactLagrangian
from herglotz.models.sweep import Sweep, numbers, trigonometry
from herglotz.models.term import value_and_slope
from herglotz.models.terms import Kinetic, LinearDamping, Potential
from herglotz.stepping.state import State, Status


class Field(NamedTuple):
    """The potential at a position."""

    V: Tensor  # (...)
    slope: Tensor  # (..., n) V′(q)


class FieldOf:
    """V and V′ of a potential at its present parameters, by plain torch operations that autograd differentiates."""

    def __init__(self, potential: Potential):
        self.stiffness, self.tilt = potential.stiffness, potential.tilt
        self.angles, self.all_angles = potential.angles, all(potential.angles)
        network, self.across = potential.network, potential.across
        self.features, self.more = potential.features, potential.more
        self.sweep = None
        if network is not None:
            self.sweep = Sweep(network, potential.angles, potential.scale, None, potential.energy)

    def __call__(self, q: Tensor) -> Field:
        """At q, (..., n)."""
        # Springs and network see q only across the translations.
        V, slope = self._own(q if self.across is None else q @ self.across)
        slope = slope if self.across is None else slope @ self.across
        if self.features is not None:
            more, bend = self.features.value_and_slope(q)
            V, slope = V + more, slope + bend
        if self.more:
            more, bend = value_and_slope(self.more, q)
            V, slope = V + more, slope + bend
        return Field(V, slope)

    def _own(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Springs and network."""
        k, b = self.stiffness, self.tilt
        x = trigonometry(q, self.angles)
        # 1 − cos q of an angle, q²/2 of a length.
        rise = numbers(q.dtype, q.device)[1] - x.c
        if not self.all_angles:
            rise = torch.where(torch.tensor(self.angles, device=q.device), rise, q * q / 2)
        V = rise @ k + x.s @ b
        slope = torch.addcmul(x.s * k, x.ds, b)
        if self.sweep is None:
            return V, slope
        value, g, _ = self.sweep(torch.cat([x.s, x.c], -1))
        n = q.shape[-1]
        return V + value, torch.addcmul(torch.addcmul(slope, g[..., :n], x.ds), g[..., n:], x.minus_sin)


class Move(NamedTuple):
    """The result of an explicit step; `there` is the potential at q1."""

    delta: Tensor  # (..., n) q1 − q0
    q1: Tensor  # (..., n)
    p1: Tensor  # (..., n)
    dp: Tensor | None  # (..., n) p1 − p0, computed without that difference, if `increments`
    L: Tensor  # (...) s1 − s0
    c: Tensor  # (...)
    there: Field


class _Constants(NamedTuple):
    """Factors that depend only on h and the parameters."""

    half: Tensor  # (..., 1) h/2
    half_h: Tensor  # (...)
    c: Tensor  # (...)
    c_1: Tensor  # (..., 1)
    half_c: Tensor  # (...) c/2
    c_minus_1: Tensor  # (...)
    inverse: Tensor  # (n, n) or (..., n, n) of m + √c h/2 b, and times h √c for a scalar h
    stretch: Tensor | None  # (..., 1) h √c where h is not


class Leapfrog:
    """The explicit step of a model at its present parameters; differentiable by plain autograd.

    `invert` replaces `torch.linalg` for the inverse of a batch of matrices, and `field` replaces `FieldOf` for V and
    V′.
    """

    def __init__(
        self,
        model: ContactLagrangian,
        invert: Callable[[Tensor], Tensor] | None = None,
        field: Callable[[Tensor], Field] | None = None,
    ):
        # The capability `explicit` has a constant mass.
        assert isinstance(model.kinetic, Kinetic)
        self.model = model
        self.field = FieldOf(model.potential) if field is None else field
        self.mass = model.kinetic.mass()
        self.friction = None if model.friction is None else model.friction.viscous
        self.invert = invert or (lambda matrix: torch.linalg.inv_ex(matrix)[0])
        self._constants: _Constants | None = None
        self._h: Tensor | None = None
        self._regular: bool | None = None

    def __call__(
        self, state: State, h: Tensor, here: Field | None = None, u: Tensor | None = None, increments: bool = False
    ) -> Move:
        """A step; `here` is the field at q0, if the step before has computed it; `increments` asks for p1 − p0."""
        q0, p0, s0 = state
        k = self.constants(h)
        V0, slope0 = self.field(q0) if here is None else here
        w = None
        if u is not None:
            # A model with inputs has forces.
            assert self.model.friction is not None
            w = self.model.friction.applied(u)
        push0 = slope0 if w is None else slope0 - w
        r = torch.addcmul(p0, k.half, push0, value=-1)
        delta = r @ k.inverse if k.inverse.ndim == 2 else (k.inverse * r[..., None, :]).sum(-1)
        delta = delta if k.stretch is None else delta * k.stretch
        q1 = q0 + delta
        there = self.field(q1)
        push1 = there.slope if w is None else there.slope - w
        p1, work, drag = torch.addcmul(k.c_1 * r, k.half, push1, value=-1), r, None
        if self.friction is not None:
            drag = self.friction * delta / 2
            p1, work = p1 - (1.0 + k.c_1) * drag, r - drag
        L = torch.addcmul(k.c_minus_1 * s0, k.half_c, (delta * work).sum(-1))
        L = torch.addcmul(L, k.half_h, torch.addcmul(there.V, k.c, V0), value=-1)
        dp = None
        if increments:
            dp = k.c_minus_1[..., None] * r - k.half * (push0 + push1)
            dp = dp if drag is None else dp - (1.0 + k.c_1) * drag
        return Move(delta, q1, p1, dp, L, k.c.expand(s0.shape), there)

    def constants(self, h: Tensor) -> _Constants:
        """The constants of a step h, kept between steps that pass the same tensor."""
        if self._h is h and self._constants is not None:
            return self._constants
        g = torch.zeros_like(h)
        if self.model.damping is not None:
            assert isinstance(self.model.damping, LinearDamping)
            g = -self.model.damping.rate * h
        c_minus_1, root = torch.expm1(g), (g / 2).exp()
        matrix, stretch, c, half = self.mass, h * root, 1.0 + c_minus_1, h / 2
        if self.friction is not None:
            matrix = matrix + torch.diag_embed((stretch / 2)[..., None] * self.friction)
        inverse = self.invert(matrix)
        if h.ndim == 0:
            inverse = inverse * stretch
        constants = _Constants(
            half[..., None], half, c, c[..., None], c / 2, c_minus_1, inverse, stretch[..., None] if h.ndim else None
        )  # fmt: skip
        self._h, self._constants, self._regular = h, constants, None
        return constants

    def regular(self, h: Tensor) -> bool:
        """Whether c ≠ 0 in every sample, for the step h of the last call."""
        if self._regular is None or self._h is not h:
            self._regular = bool((self.constants(h).c != 0).all())
        return self._regular


def leapfrog(L_d: DiscreteLagrangian) -> Leapfrog | None:
    """The explicit step of L_d, or None where its terms ask for an iteration."""
    return Leapfrog(L_d) if type(L_d) is ContactLagrangian and L_d.capabilities.explicit else None


def explicit_status(q1: Tensor, p1: Tensor, s1: Tensor, c: Tensor, regular: bool) -> Tensor | None:
    """(...) SINGULAR where c = 0, DIVERGED where a value is not finite, else CONVERGED; None: all have converged."""
    if s1.numel() == 1 and regular:
        numbers = (*q1.flatten().tolist(), *p1.flatten().tolist(), s1.item())
        if all(map(isfinite, numbers)):
            return None
    # The sum is 0 where all numbers are finite, else NaN.
    good = (join(q1, p1, s1) * 0).sum(-1) == 0
    if regular and bool(good.all()):
        return None
    status = torch.where(c == 0, int(Status.SINGULAR), int(Status.CONVERGED))
    return torch.where(good, status, int(Status.DIVERGED)).to(torch.uint8)
