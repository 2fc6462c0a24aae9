"""The step equation with set-valued dry friction, as a single-valued equation that Newton's iteration solves.

F(Δ) + λ = 0 with λ ∈ −w Sgn(Δ), w = c h (τ + ε) the impulse that friction can hold, is an inclusion. Each point (Δ, λ)
of the graph of Sgn is given by a single number z = Δ − λ/K for any K > 0 (Minty's parametrisation):

    Δ = z − clamp(z, −w/K, w/K),    λ = −K (z − Δ).

A coordinate that slides has Δ ≠ 0 and λ = ∓w, which the forces at Δ contain already; a coordinate that sticks has Δ = 0
and λ = −K z. So z solves

    G(z) = F(Δ(z)) − K z [sticks] = 0,    ∂G/∂z = ∂F/∂Δ [slides] − K [sticks],

which is piecewise smooth, with as many equations as unknowns. K is the size of the diagonal of ∂F/∂Δ at rest, so that
z has the units of q. Source: J. J. Moreau, Unilateral contact and dry friction in finite freedom dynamics (1988);
V. Acary & B. Brogliato, Numerical Methods for Nonsmooth Dynamical Systems (2008).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, TypeGuard

import torch
from torch import Tensor

from herglotz.mechanics.legendre import soft_threshold, unheld_jacobian, unheld_residual
from herglotz.mechanics.newton import Point
from herglotz.stepping.partials_equation import StepEquation

# Sweeps of Gauss–Seidel find which coordinates stick; Newton's iteration then finds how far the other coordinates move.
SWEEPS = 8


class PartialsAtHand(StepEquation, Protocol):
    """A step equation whose `rest` is its partials, with set-valued forces."""

    p0: Tensor  # (..., n)
    sticking: bool


class Rest(NamedTuple):
    """The start z, of the equation that is linear in Δ, K = `stiffness`, and w/K = `bound` on |z| of sticking."""

    start: Tensor  # (..., n)
    stiffness: Tensor  # (..., n)
    bound: Tensor  # (..., n)


def at_rest(equation: PartialsAtHand) -> Rest:
    """The start of the iteration, exact for n = 1 and by Gauss–Seidel for more, with the constants of z.

    The friction of the equation, which is in q1 or, in increments, in Δ = q1 − q0, is set-valued.
    """
    zero = torch.zeros_like(equation.q0)
    P = equation(zero if equation.increments else equation.q0, True).rest
    F, J = unheld_residual(P, equation.p0), unheld_jacobian(P, equation.p0)
    stiffness = J.diagonal(0, -2, -1).abs()
    bound = P.force.held / stiffness
    z = alone = F / stiffness
    couples = J / stiffness[..., None]
    n = z.shape[-1]
    for _ in range(SWEEPS if n > 1 else 0):
        for i in range(n):
            delta = soft_threshold(z, bound)
            others = (couples[..., i, :] * delta).sum(-1) - couples[..., i, i] * delta[..., i]
            z = torch.cat([z[..., :i], (alone[..., i] + others)[..., None], z[..., i + 1 :]], -1)
    return Rest(z, stiffness, bound)


class StickSlip:
    """The step equation in z of an equation in q1 or Δ with set-valued friction; see the head of this module.

    K = `stiffness` and w/K = `bound` are those of `at_rest`.
    """

    def __init__(self, equation: PartialsAtHand, stiffness: Tensor, bound: Tensor):
        self.equation, self.stiffness, self.bound = equation, stiffness, bound

    def unknown(self, z: Tensor) -> Tensor:
        """The unknown of the equation: Δ, or q1."""
        delta = soft_threshold(z, self.bound)
        return delta if self.equation.increments else self.equation.q0 + delta

    def slides(self, z: Tensor) -> Tensor:
        """Where the forces are evaluated at Δ ≠ 0: q0 + Δ may round to q0."""
        unknown = self.unknown(z)
        return (unknown if self.equation.increments else unknown - self.equation.q0).abs() > 0

    def __call__(self, x: Tensor, second: bool) -> Point:  # noqa: ARG002  one signature for all
        """G and ∂G/∂z at z = x."""
        P, slides = self.equation(self.unknown(x), True).rest, self.slides(x)
        G = unheld_residual(P, self.equation.p0) - torch.where(slides, 0.0, self.stiffness * x)
        J = torch.where(slides[..., None, :], unheld_jacobian(P, self.equation.p0), 0.0)
        return Point(G, J - torch.diag_embed(torch.where(slides, 0.0, self.stiffness)), P)


def sticks(equation: StepEquation) -> TypeGuard[PartialsAtHand]:
    """Whether dry friction can hold a coordinate of this step; `rest` then is the partials."""
    return getattr(equation, "sticking", False)
