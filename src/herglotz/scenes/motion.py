"""The equations of motion of a contact system, from explicit derivatives of L or from any L by autograd."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics.scalar_fields import derivatives
from herglotz.scenes.scene import State, StateFunction

Balance = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]


@dataclass(frozen=True)
class Motion:
    """The equations of motion of x = (q, y, s), where y is the momentum p or the velocity v, differentiable in x.

    No acceleration is needed. L_s is the rate of the conformal factor, ċ = c L_s.
    """

    start: StateFunction  # (q, v, s) → y
    balance: Balance  # (q, y, s) → (q̇, p, ṗ, ṡ, L_s)

    def vector_field(self, q: Tensor, p: Tensor, s: Tensor) -> State:
        """(q̇, ṗ, ṡ) of equations whose y is the momentum."""
        q_dot, _, p_dot, s_dot, _ = self.balance(q, p, s)
        return q_dot, p_dot, s_dot


def herglotz_motion(
    lagrangian: StateFunction,
    momentum: StateFunction,
    velocity: StateFunction,
    force: StateFunction,  # (q, v, s) → L_q, (..., n)
    rate: StateFunction,  # (q, v, s) → L_s, (...)
) -> Motion:
    """Return the equations in (q, p, s) by explicit derivatives, the fast form: q̇ = v, ṗ = L_q + L_s p, ṡ = L."""

    def balance(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        v = velocity(q, p, s)
        L_s = rate(q, v, s)
        return v, p, force(q, v, s) + L_s[..., None] * p, lagrangian(q, v, s), L_s

    return Motion(momentum, balance)


def constant_rate(L_s: float) -> StateFunction:
    """Return the rate L_s of a contact term linear in s, L = … + L_s s."""
    return lambda q, v, s: torch.full_like(s, L_s)  # noqa: ARG005


def lagrangian_motion(lagrangian: StateFunction) -> Motion:
    """Return the equations of L(q, v, s) in (q, v, s) by autograd: q̇ = v, ṗ = L_q + L_s p, ṡ = L."""

    def balance(q: Tensor, v: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        L = derivatives(lagrangian, q, v, s)
        return v, L.D2, L.D1 + L.D3[..., None] * L.D2, L.L, L.D3

    return Motion(lambda q, v, s: v, balance)  # noqa: ARG005
