"""Continuous dynamics: functions F on Q with their derivatives, and the sections j¹F of T*Q × R → Q."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from torch import Tensor

from herglotz.mechanics.scalar_fields import gradient

# F(q), (..., n) → (...).
Function = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class FunctionGerm:
    """A function on Q with its first two derivatives at a point."""

    S: Tensor  # (...)
    dS: Tensor  # (..., n)
    d2S: Tensor  # (..., n, n)


@runtime_checkable
class HasGerm(Protocol):
    """A function on Q with derivatives in closed form."""

    def germ(self, q: Tensor, /) -> FunctionGerm:
        """Value, gradient and Hessian at q."""
        ...


def germ(F: Function, q: Tensor) -> FunctionGerm:
    """Value, gradient and Hessian of F at q, by the method `germ` of F or else by autograd."""
    return F.germ(q) if isinstance(F, HasGerm) else FunctionGerm(*gradient(F, q, order=2))


def prolongation(F: Function, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """γ(q) = j¹F(q) = (q, dF(q), F(q)), shapes (..., n), (..., n), (...).

    Source: first prolongation in the paper; with F = S_d^k the section γ^k.
    """
    if isinstance(F, HasGerm):
        at = F.germ(q)
        return q, at.dS, at.S
    value, F_q, _ = gradient(F, q)
    return q, F_q, value
