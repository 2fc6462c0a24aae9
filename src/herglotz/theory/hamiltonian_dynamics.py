"""Discrete Hamiltonian dynamics: L⁻, H⁺ and H⁻ by Legendre transforms, the Hamilton equations, and steps by H± alone.

`Stepper` inverts FL⁻, which exists under weaker conditions (erratum E4). The steps of this file serve comparisons, and
systems given by a discrete Hamiltonian. H is any callable H(a, b, s, h); `partials` differentiates H.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.contact import jacobian
from herglotz.mechanics.legendre import scaled_margin
from herglotz.mechanics.newton import find_root, solve
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials, value
from herglotz.scenes.rules import implicit
from herglotz.scenes.special import as_step


class LeftLagrangian:
    """L⁻(q0, q1, s1) = s1 − s0, where s0 + L_d(q0, q1, s0) = s1.

    1 − D3L⁻ = 1/c,    p0 = −D1L⁻,    p1 = D2L⁻ / (1 − D3L⁻).

    L⁻ solves the scalar equation x = L_d(q0, q1, s1 − x), by Newton's method from 0. The slope of the equation is c:
    the solution is unique if c > 0 for every s0. L⁻ is three times differentiable, and NaN where c = 0 or no solution
    is found; `regularity` names the cause. Calls raise InputError if L_d comes with forces.

    Source: erratum E5, for the paper's L_d(q_k, q_{k+1}, s_{k+1}) in the left discrete Hamiltonian.
    """

    def __init__(self, L_d: DiscreteLagrangian):
        self.L_d = L_d

    def __call__(self, q0: Tensor, q1: Tensor, s1: Tensor, h: Tensor | float) -> Tensor:
        """L⁻, shape (...)."""
        h = as_step(h, q0)
        with torch.no_grad():
            unforced(partials(self.L_d, q0, q1, s1, h))
        return implicit(lambda x: self.L_d(q0, q1, s1 - x, h), q0, q1, s1, h)


def unforced(P: Partials) -> Partials:
    """Return P. Raise InputError if P has forces, which are not derivatives of an action."""
    if P.force is not None:
        raise InputError("this L_d comes with forces F⁻, F⁺; actions and discrete Hamiltonians need one without")
    return P


def right_hamiltonian_on_flow(q1: Tensor, p1: Tensor, L: Tensor) -> Tensor:
    """H⁺ = p1·q1 − L_d of a step that is already solved; shape (...)."""
    return (p1 * q1).sum(-1) - L


class RightHamiltonian:
    """H⁺(q0, p1, s0) = p1·q1 − L_d(q0, q1, s0) where D2L_d(q0, q1, s0) = p1.

    D1H⁺ = −D1L_d,    D2H⁺ = q1,    D3H⁺ = −D3L_d  (envelope theorem).

    H⁺ exists where det D2D2L_d ≠ 0; stepping does *not* need this condition (erratum E4). NaN where Newton's method
    finds no q1, or where that determinant is zero to rounding; `regularity` names the condition. H⁺ can have several
    branches; `near` (..., n), the start of Newton's method for q1, by default q0, selects one.

    Source: right discrete Hamiltonian of the paper.
    """

    def __init__(self, L_d: DiscreteLagrangian, near: Tensor | None = None):
        self.L_d = L_d
        self.near = near

    def position(self, q0: Tensor, p1: Tensor, s0: Tensor, h: Tensor | float) -> Tensor:
        """q1 with D2L_d(q0, q1, s0) = p1, without a graph; shape (..., n), NaN where there is none."""
        return self._solved(q0, p1, s0, h)[0]

    def __call__(self, q0: Tensor, p1: Tensor, s0: Tensor, h: Tensor | float) -> Tensor:
        """H⁺, shape (...); twice differentiable."""
        q1, D22 = self._solved(q0, p1, s0, h)
        H = right_hamiltonian_on_flow(q1, p1, value(self.L_d, q0, q1, s0, h))
        if torch.is_grad_enabled():
            # H⁺ is stationary in q1. A term of value 0 has the second derivatives due to q1.
            F = partials(self.L_d, q0, q1, s0, h).D2 - p1
            F = F - F.detach()
            H = H + 0.5 * (F * solve(D22, F)).sum(-1)
        return H

    def _solved(self, q0: Tensor, p1: Tensor, s0: Tensor, h: Tensor | float) -> tuple[Tensor, Tensor]:
        """The position q1, NaN where there is none, and D22 there."""

        def equations(q1: Tensor) -> tuple[Tensor, Tensor]:
            P = unforced(partials(self.L_d, q0, q1, s0, h, order=2))
            return P.D2 - p1, P.D22

        shape = torch.broadcast_shapes(q0.shape[:-1], p1.shape[:-1], s0.shape, torch.as_tensor(h).shape)
        start = (q0 if self.near is None else self.near).broadcast_to(*shape, q0.shape[-1])
        q1 = find_root(equations, start).solved
        with torch.no_grad():
            P = partials(self.L_d, q0, q1, s0, h, order=2)
            # D22 is inverted. It is singular where its margin is rounding of the blocks of L_d.
            found = scaled_margin(P.D22, P.D12, P.D11, P.D22) > 1e3 * torch.finfo(q0.dtype).eps
            return torch.where(found[..., None], q1, torch.nan), P.D22


class LeftHamiltonian:
    """H⁻(p0, q1, s1) = −p0·q0 − L⁻(q0, q1, s1) where p0 = −D1L⁻(q0, q1, s1).

    D1H⁻ = −q0,    D2H⁻ = −D2L⁻,    D3H⁻ = −D3L⁻  (envelope theorem).

    H⁻ is the right Hamiltonian of L⁻ with the two positions exchanged, at the momentum −p0. H⁻ exists where c ≠ 0 and
    det D1D1L⁻ ≠ 0; NaN elsewhere, and where Newton's method finds no q0. `near` (..., n) is the start of Newton's
    method for q0, by default q1.

    Source: left discrete Hamiltonian of the paper, with the left Lagrangian of erratum E5.
    """

    def __init__(self, L_d: DiscreteLagrangian, near: Tensor | None = None):
        left = LeftLagrangian(L_d)
        self.mirror = RightHamiltonian(lambda q1, q0, s1, h: left(q0, q1, s1, h), near)

    def __call__(self, p0: Tensor, q1: Tensor, s1: Tensor, h: Tensor | float) -> Tensor:
        """H⁻, shape (...); twice differentiable."""
        return self.mirror(q1, -p0, s1, h)


# Both are functions of two vectors, a scalar and h.
DiscreteHamiltonian = DiscreteLagrangian


def right_equations(
    P: Partials,
    p1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
) -> tuple[Tensor, Tensor, Tensor]:
    """q1 = D2H⁺, p0 = D1H⁺/(1 − D3H⁺), s1 = s0 + p1·D2H⁺ − H⁺, from the partials of H⁺ at (q0, p1, s0).

    Source: right discrete contact Hamilton equations of the paper.
    """
    return P.D2, P.D1 / (1 - P.D3)[..., None], s0 + (p1 * P.D2).sum(-1) - P.L


def left_equations(
    P: Partials,
    p0: Tensor,  # (..., n)
    s1: Tensor,  # (...)
) -> tuple[Tensor, Tensor, Tensor]:
    """q0 = −D1H⁻, p1 = −D2H⁻/(1 + D3H⁻), s0 = s1 + H⁻ − p0·D1H⁻, from the partials of H⁻ at (p0, q1, s1).

    Source: left discrete contact Hamilton equations of the paper, corrected by erratum E5.
    """
    return -P.D1, -P.D2 / (1 + P.D3)[..., None], s1 + P.L - (p0 * P.D1).sum(-1)


def right_step(
    H_plus: DiscreteHamiltonian,
    q0: Tensor,  # (..., n)
    p0: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """(q1, p1, s1) by the right equations: D1H⁺(q0, p1, s0) = (1 − D3H⁺) p0 is solved for p1.

    NaN where Newton's method finds no solution.
    """

    def missed(p1: Tensor) -> Tensor:
        P = partials(H_plus, q0, p1, s0, h)
        return P.D1 - (1 - P.D3)[..., None] * p0

    p1 = find_root(lambda p1: jacobian(missed, p1), p0).solved
    q1, _, s1 = right_equations(partials(H_plus, q0, p1, s0, h), p1, s0)
    return q1, p1, s1


def left_step(
    H_minus: DiscreteHamiltonian,
    q0: Tensor,  # (..., n)
    p0: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor]:
    """(q1, p1, s1) by the left equations: the equations for q0 and s0 are solved for (q1, s1) together.

    NaN where Newton's method finds no solution.
    """
    n = q0.shape[-1]

    def missed(x: Tensor) -> Tensor:
        q, _, s = left_equations(partials(H_minus, p0, x[..., :n], x[..., n], h), p0, x[..., n])
        return torch.cat([q - q0, (s - s0)[..., None]], -1)

    start = torch.cat([q0, s0[..., None]], -1)
    # Positions and actions have different units, and so different scales.
    action = s0.abs() + (p0 * q0).sum(-1).abs()
    scale = torch.cat([q0.abs().amax(-1, keepdim=True).expand(q0.shape), action[..., None]], -1)
    x = find_root(lambda x: jacobian(missed, x), start, torch.maximum(scale, start.abs())).solved
    q1, s1 = x[..., :n], x[..., n]
    _, p1, _ = left_equations(partials(H_minus, p0, q1, s1, h), p0, s1)
    return q1, p1, s1
