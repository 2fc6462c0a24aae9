"""The step equation with set-valued dry friction, as one single-valued equation that Newton's iteration solves.

F(Δ) + λ = 0 with λ ∈ −w Sgn(Δ), w = c h (τ + ε) the impulse that friction can hold, is an inclusion. Each point (Δ, λ)
of the graph of Sgn is given by one number z = Δ − λ/K for any K > 0 (Minty's parametrisation):

    Δ = z − clamp(z, −w/K, w/K),    λ = −K (z − Δ).

A coordinate that slides has Δ ≠ 0 and λ = ∓w, which the forces at Δ hold already; one that sticks has Δ = 0 and
λ = −K z. So z solves

    G(z) = F(Δ(z)) − K z [sticks] = 0,    ∂G/∂z = ∂F/∂Δ [slides] − K [sticks],

which is piecewise smooth, with as many equations as unknowns. K is the size of the diagonal of ∂F/∂Δ at rest, so that
z has the units of q. Source: J. J. Moreau, Unilateral contact and dry friction in finite freedom dynamics (1988);
V. Acary & B. Brogliato, Numerical Methods for Nonsmooth Dynamical Systems (2008).
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.mechanics.legendre import unheld_jacobian, unheld_residual
from herglotz.mechanics.newton import Point
from herglotz.models import capabilities
from herglotz.stepping.partials_equation import End, PartialsEquation

SWEEPS = 8  # of Gauss–Seidel: they find which coordinates stick, Newton's iteration finds by how much the others move


class StickSlip:
    """A step equation in the unknown z, for an equation whose forces hold; see the head of this module.

    Parameters
    ----------
    equation
        In the unknown q1 or, in increments, Δ = q1 − q0.
    rest
        The equation's point at Δ = 0, of order 2: its forces say what friction can hold.
    """

    def __init__(self, equation: PartialsEquation, rest: Point):
        self.equation = equation
        P = rest.rest
        self.F, self.J = unheld_residual(P, equation.p0), unheld_jacobian(P, equation.p0)
        self.stiffness = self.J.diagonal(0, -2, -1).abs()  # K
        self.threshold = P.force.held / self.stiffness  # w/K

    def start(self) -> Tensor:
        """The z of the equation that is linear in Δ, F + J Δ at rest: exact for n = 1, by Gauss–Seidel for more."""
        z = alone = self.F / self.stiffness
        couples = self.J / self.stiffness[..., None]
        n = z.shape[-1]
        for _ in range(SWEEPS if n > 1 else 0):
            for i in range(n):
                delta = self.increment(z)
                others = (couples[..., i, :] * delta).sum(-1) - couples[..., i, i] * delta[..., i]
                z = torch.cat([z[..., :i], (alone[..., i] + others)[..., None], z[..., i + 1 :]], -1)
        return z

    def increment(self, z: Tensor) -> Tensor:
        """Δ(z), exactly 0 where a coordinate sticks."""
        return z - z.clamp(-self.threshold, self.threshold)

    def unknown(self, z: Tensor) -> Tensor:
        """What the equation itself has for its unknown: Δ, or q1."""
        delta = self.increment(z)
        return delta if self.equation.increments else self.equation.q0 + delta

    def __call__(self, x: Tensor, second: bool) -> Point:
        """G at z = x, and ∂G/∂z if `second`."""
        order = 2 if second else self.equation.order
        unknown = self.unknown(x)
        point = self.equation(unknown, second)
        # As the forces see it: q0 + Δ may round to q0.
        P, sticks = point.rest, unknown == (0.0 if self.equation.increments else self.equation.q0)
        G = unheld_residual(P, self.equation.p0) - torch.where(sticks, self.stiffness * x, 0.0)
        if order != 2:
            return Point(G, None, P)
        J = torch.where(sticks[..., None, :], 0.0, unheld_jacobian(P, self.equation.p0))
        return Point(G, J - torch.diag_embed(torch.where(sticks, self.stiffness, 0.0)), P)

    def push(self, point: Point) -> Tensor:
        """See `Equation`."""
        return self.equation.push(point)

    def end(self, x: Tensor, point: Point) -> End:
        """See `Equation`."""
        return self.equation.end(x, point)

    def typical_increment(self) -> Tensor:
        """See `Equation`."""
        return self.equation.typical_increment()


def stick_slip(equation: object) -> StickSlip | None:
    """The equation in z where friction can hold a coordinate of this step; None where no friction is set-valued."""
    if not isinstance(equation, PartialsEquation):
        return None
    made_of = capabilities(equation.L_d)
    if made_of is None or not made_of.sticking:
        return None
    rest = torch.zeros_like(equation.q0) if equation.increments else equation.q0
    return StickSlip(equation, equation(rest, True))
