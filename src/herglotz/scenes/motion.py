"""A contact system as a vector field to integrate, from explicit derivatives of L, or from any L."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.scenes.scene import State, StateFunction
from herglotz.theory.continuous import derivatives, herglotz_acceleration

Field = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor]]
Balance = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor, Tensor, Tensor]]


@dataclass(frozen=True)
class Motion:
    """ẋ for x = (q, y, s), where y is the momentum p or the velocity v, differentiable in x.

    Parameters
    ----------
    field
        (q, y, s) → (q̇, ẏ, ṡ, L_s), where L_s is the rate at which the contact form is scaled, ċ = c L_s.
    start
        (q, v, s) → y: where a velocity is known.
    balance
        (q, y, s) → (q̇, p, ṗ, ṡ, L_s), which for a Lagrangian needs no acceleration.
    """

    field: Field
    start: StateFunction
    balance: Balance

    def vector_field(self, q: Tensor, y: Tensor, s: Tensor) -> State:
        """(q̇, ẏ, ṡ)."""
        return self.field(q, y, s)[:3]


def herglotz_motion(
    lagrangian: StateFunction,
    momentum: StateFunction,
    velocity: StateFunction,
    force: StateFunction,  # (q, v, s) → L_q, (..., n)
    rate: StateFunction,  # (q, v, s) → L_s, (...)
) -> Motion:
    """Return the field of explicit derivatives, the fastest form: q̇ = v(q, p, s), ṗ = L_q + L_s p, ṡ = L."""

    def field(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        v = velocity(q, p, s)
        L_s = rate(q, v, s)
        return v, force(q, v, s) + L_s[..., None] * p, lagrangian(q, v, s), L_s

    def balance(q: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        q_dot, p_dot, s_dot, rate = field(q, p, s)
        return q_dot, p, p_dot, s_dot, rate

    return Motion(field, momentum, balance)


def constant_rate(L_s: float) -> StateFunction:
    """Return the rate L_s of a contact term linear in s, L = … + L_s s."""
    return lambda q, v, s: torch.full_like(s, L_s)  # noqa: ARG005


def lagrangian_motion(lagrangian: StateFunction) -> Motion:
    """Return the field of L(q, v, s) by autograd, in (q, v, s): q̇ = v, v̇ by Herglotz's equations, ṡ = L."""

    def field(q: Tensor, v: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        L = derivatives(lagrangian, q, v, s)
        return v, herglotz_acceleration(lagrangian, q, v, s), L.L, L.D3

    def balance(q: Tensor, v: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        L = derivatives(lagrangian, q, v, s)
        return v, L.D2, L.D1 + L.D3[..., None] * L.D2, L.L, L.D3

    return Motion(field, lambda q, v, s: v, balance)  # noqa: ARG005
