"""The step equation D1 L_d(q0, q1, s0) + c p0 = 0 solved by `herglotz.mechanics.newton`, with a status per sample.

Set-valued dry friction: F(Δ) + λ = 0 with λ ∈ −w Sgn(Δ), w = c h (τ + ε) the impulse that friction can hold, is an
inclusion. Each point (Δ, λ) of the graph of Sgn is given by a single number z = Δ − λ/K for any K > 0 (Minty's
parametrisation):

    Δ = z − clamp(z, −w/K, w/K),    λ = −K (z − Δ).

A coordinate that slides has Δ ≠ 0 and λ = ∓w, which the forces at Δ contain already; a coordinate that sticks has Δ = 0
and λ = −K z. So z solves

    G(z) = F(Δ(z)) − K z [sticks] = 0,    ∂G/∂z = ∂F/∂Δ [slides] − K [sticks],

which is piecewise smooth, with as many equations as unknowns. K is the size of the diagonal of ∂F/∂Δ at rest, so that z
has the units of q. Source: J. J. Moreau, Unilateral contact and dry friction in finite freedom dynamics (1988); V.
Acary & B. Brogliato, Numerical Methods for Nonsmooth Dynamical Systems (2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite
from typing import NamedTuple, Protocol, TypeGuard

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian, Partials
from herglotz.mechanics.legendre import soft_threshold, unheld_jacobian, unheld_residual
from herglotz.mechanics.newton import Found, Point, Rules, largest, newton, newton_step, norm, solve
from herglotz.stepping.equation import End, PartialsEquation, StepEquation
from herglotz.stepping.state import State, Status

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


# Machine epsilons of the size of a sample below which a Newton step is rounding.
ROUNDING = 1e3


@dataclass(frozen=True)
class Solution:
    """The solved step; `P`, of order 2, is evaluated at q1, so a caller computes no partial derivative again."""

    q1: Tensor  # (..., n)
    P: Partials
    status: Tensor  # (...) Status values, uint8
    residual: Tensor  # (...) |J⁻¹F|, the error left in q1, in units of q
    iterations: int


def solve_step(
    L_d: DiscreteLagrangian,
    state: State,
    h: Tensor,  # () or (...)
    guess: Tensor,  # (..., n) where the iteration starts
    tol: float,
    max_iterations: int = 30,
) -> Solution:
    """Solve F(q1) = D1 L_d(q0, q1, s0) + c p0 = 0 for q1 (FL⁻ inverted; never through H⁺, erratum E4).

    A sample has converged when its next Newton step is below `tol` times the size of its positions. Samples are
    independent: each has its own Jacobian, its own step length and its own status.
    """
    found = find_root(PartialsEquation(L_d, state, h, 2, False), guess, tol, max_iterations, 2)
    P = found.point.rest
    status, _ = status_of(found, End(P.D2, P.L, P.c))
    return Solution(found.x, P, status, found.residual, found.iterations)


def find_root(equation: StepEquation, guess: Tensor, tol: float, max_iterations: int, order: int) -> Found:
    """Solve a step equation by Newton's iteration.

    With `order` 2 every Jacobian is fresh, the last Jacobian too. With `order` 1, an iteration that starts close to the
    solution keeps its Jacobian and costs first derivatives only; the solution is the same to `tol`.
    """
    sizes = _Sizes(equation)
    if sticks(equation):
        start, *held = at_rest(equation)
        sticky = StickSlip(equation, *held)
        found = newton(sticky, start, Rules(tol, max_iterations), sizes.tensors)
        x = sticky.unknown(found.x)
        return found._replace(x=x, point=equation(x, order == 2), mixed=False)
    x = guess - equation.q0 if equation.increments else guess
    rules = Rules(tol, max_iterations, keep=order == 1)
    if x.shape[:-1].numel() == 1:
        return newton(equation, x, rules, sizes.numbers, alone=True)
    found = newton(equation, x, rules, sizes.tensors)
    return found._replace(point=equation(found.x, order == 2)) if found.mixed else found


@dataclass(frozen=True)
class _Sizes:
    """The scale of the tolerance (the size of the positions or, in increments, of the increment), and of rounding."""

    equation: StepEquation

    def tensors(self, x: Tensor, point: Point, left: Tensor) -> tuple[Tensor, Tensor]:
        """Both scales, (...) each; see `herglotz.mechanics.newton`."""
        own = self.equation.increments
        size = largest(x) + largest(solve(point.J, self.equation.push(point))) if own else largest(self.equation.q0)
        scale = torch.maximum(size, torch.maximum(largest(x), left))
        limits = torch.finfo(scale.dtype)
        scale = torch.nan_to_num(scale, nan=1.0, posinf=1.0).clamp(min=_least(limits))
        return scale, ROUNDING * limits.eps * torch.maximum(scale, self.equation.typical_increment())

    def numbers(self, x: Tensor, point: Point, left: float) -> tuple[float, float]:
        """Both scales of a single sample."""
        size = norm(x.flatten().tolist())
        if self.equation.increments:
            other = newton_step(point.J, self.equation.push(point))[2] + size
        else:
            other = norm(self.equation.q0.flatten().tolist())
        limits = torch.finfo(x.dtype)
        scale = max(size, other, left, _least(limits)) if isfinite(size + other + left) else 1.0
        return scale, ROUNDING * limits.eps * max(scale, self.equation.typical_increment().item())


def _least(limits: torch.finfo) -> float:
    """The smallest scale: a tolerance of denormal size would keep a motion from coming to rest."""
    return limits.tiny / limits.eps


def status_of(found: Found, end: End) -> tuple[Tensor, bool]:
    """The status of each sample, and whether all samples have converged."""
    merit, residual, done, L, c = found.merit, found.residual, found.done, end.L, end.c
    if found.healthy:
        good = isfinite(L.item()) and c.item() != 0
    else:
        good = bool((done & torch.isfinite(residual + merit + L) & (c != 0)).all())
    if good:
        return torch.zeros_like(merit, dtype=torch.uint8), True
    finite = torch.isfinite(merit) & torch.isfinite(L)
    status = torch.full_like(merit, Status.MAX_ITERATIONS, dtype=torch.uint8)
    status = torch.where(done, Status.CONVERGED, status)
    status = torch.where(~torch.isfinite(residual) | (c == 0), Status.SINGULAR, status)
    return torch.where(finite, status, Status.DIVERGED).to(torch.uint8), False
