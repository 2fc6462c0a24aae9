"""The protocol of a step equation, and the equation of any L_d by partials."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from herglotz.mechanics import (
    DiscreteLagrangian,
    Partials,
    momentum_jacobian,
    momentum_plus,
    momentum_residual,
    partials,
)
from herglotz.mechanics.newton import Point
from herglotz.models import capabilities
from herglotz.stepping.state import State


class End(NamedTuple):
    """The result of a solved step."""

    p1: Tensor  # (..., n)
    L: Tensor  # (...) s1 − s0
    c: Tensor  # (...)
    dp: Tensor | None = None  # (..., n) p1 − p0 if computed without that difference


class StepEquation(Protocol):
    """The step equation in the unknown x: q1 or, in increments, Δ = q1 − q0."""

    q0: Tensor  # (..., n)
    increments: bool

    def __call__(self, x: Tensor, second: bool) -> Point:
        """F, and J if `second`."""
        ...

    def push(self, point: Point) -> Tensor:
        """The momentum c p0, (..., n)."""
        ...

    def end(self, x: Tensor, point: Point) -> End:
        """p1 = D2 + F⁺, L and c at a solution."""
        ...

    def typical_increment(self) -> Tensor:
        """The size (...) to which the rounding of J⁻¹F is relative even at rest; 0 if unknown."""
        ...


def partials_at(L_d: Any, q0: Tensor, x: Tensor, s0: Tensor, h: Tensor, order: int, increments: bool) -> Partials:
    """The partials of L_d at (q0, x) or, in increments, at (q0, q0 + x), which L_d then has to offer."""
    return L_d.partials_increment(q0, x, s0, h, order) if increments else partials(L_d, q0, x, s0, h, order)


class PartialsEquation:
    """The step equation of any L_d; `rest` holds its partials."""

    def __init__(self, L_d: DiscreteLagrangian, state: State, h: Tensor, order: int, increments: bool):
        self.L_d, self.h, self.order, self.increments = L_d, h, order, increments
        self.q0, self.p0, self.s0 = state
        # Whether dry friction can hold a coordinate.
        made_of = capabilities(L_d)
        self.sticking = made_of is not None and made_of.sticking

    def __call__(self, x: Tensor, second: bool) -> Point:
        """See `StepEquation`."""
        order = 2 if second else self.order
        P = partials_at(self.L_d, self.q0, x, self.s0, self.h, order, self.increments)
        return Point(momentum_residual(P, self.p0), momentum_jacobian(P, self.p0) if order == 2 else None, P)

    def push(self, point: Point) -> Tensor:
        """See `StepEquation`."""
        return point.rest.c[..., None] * self.p0

    def end(self, x: Tensor, point: Point) -> End:  # noqa: ARG002  one signature for all
        """See `StepEquation`."""
        return End(momentum_plus(point.rest), point.rest.L, point.rest.c)

    def typical_increment(self) -> Tensor:
        """See `StepEquation`."""
        of_model = getattr(self.L_d, "typical_increment", None)
        h = self.h.expand(self.s0.shape)
        return torch.zeros_like(h) if of_model is None else of_model(h)
