"""Discrete Hamiltonian dynamics: H⁺ and H⁻ by the discrete Legendre transforms of L_d and of L⁻."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials, value
from herglotz.mechanics.regularity import scaled_margin
from herglotz.theory.left import LeftLagrangian, unforced


def right_hamiltonian_on_flow(q1: Tensor, p1: Tensor, L: Tensor) -> Tensor:
    """H⁺ = p1·q1 − L_d of a step that is already solved; shape (...)."""
    return (p1 * q1).sum(-1) - L


class RightHamiltonian:
    """H⁺(q0, p1, s0) = p1·q1 − L_d(q0, q1, s0) where D2L_d(q0, q1, s0) = p1, with its derivatives.

    D1H⁺ = −D1L_d,    D2H⁺ = q1,    D3H⁺ = −D3L_d  (envelope theorem).

    H⁺ exists where det D2D2L_d ≠ 0; stepping does *not* need this condition (erratum E4). NaN where Newton's method
    finds no q1, or where that determinant is zero to rounding; `regularity` names the condition.

    Parameters
    ----------
    L_d
        The discrete Lagrangian.
    near
        (..., n) start of Newton's method for q1, by default q0. H⁺ can have several branches; `near` selects one.

    Source: right discrete Hamiltonian of the paper.
    """

    def __init__(self, L_d: DiscreteLagrangian, near: Tensor | None = None):
        self.L_d = L_d
        self.near = near

    def position(self, q0: Tensor, p1: Tensor, s0: Tensor, h: Tensor | float) -> Tensor:
        """q1 with D2L_d(q0, q1, s0) = p1, without a graph; shape (..., n), NaN where there is none."""

        def equations(q1: Tensor) -> tuple[Tensor, Tensor]:
            P = partials(self.L_d, q0, q1, s0, h, order=2)
            return P.D2 - p1, P.D22

        with torch.no_grad():
            shape = torch.broadcast_shapes(q0.shape[:-1], p1.shape[:-1], s0.shape, torch.as_tensor(h).shape)
            q0, p1 = (x.detach().broadcast_to(*shape, x.shape[-1]) for x in (q0, p1))
            s0 = s0.detach().broadcast_to(shape)
            start = q0 if self.near is None else self.near.broadcast_to(q0.shape)
            q1 = find_root(equations, start).solved
            P = unforced(partials(self.L_d, q0, q1, s0, h, order=2))
            # D22 is inverted. It is singular where its margin is rounding of the blocks of L_d.
            fold = ~(scaled_margin(P.D22, P.D12, P.D11, P.D22) > 1e3 * torch.finfo(q1.dtype).eps)
            return torch.where(fold[..., None], torch.nan, q1)

    def __call__(self, q0: Tensor, p1: Tensor, s0: Tensor, h: Tensor | float) -> Tensor:
        """H⁺, shape (...); once differentiable, since H⁺ is stationary in q1."""
        q1 = self.position(q0, p1, s0, h)
        return right_hamiltonian_on_flow(q1, p1, value(self.L_d, q0, q1, s0, h))

    def partials(self, q0: Tensor, p1: Tensor, s0: Tensor, h: Tensor | float, order: int = 1) -> Partials:
        """H⁺ and its derivatives with respect to (q0, p1, s0), by the Legendre transform in the second argument."""
        q1 = self.position(q0, p1, s0, h)
        P = partials(self.L_d, q0, q1, s0, h, order)
        first = (right_hamiltonian_on_flow(q1, p1, P.L), -P.D1, q1, -P.D3)
        if order == 1:
            return Partials(*first)
        G = torch.linalg.inv_ex(P.D22)[0]
        B = P.D12 @ G
        v = (G @ P.D23[..., None])[..., 0]
        return Partials(
            *first,
            D11=B @ P.D12.mT - P.D11,
            D12=-B,
            D22=G,
            D13=(P.D12 @ v[..., None])[..., 0] - P.D13,
            D23=-v,
            D33=(P.D23 * v).sum(-1) - P.D33,
        )


class LeftHamiltonian:
    """H⁻(p0, q1, s1) = −p0·q0 − L⁻(q0, q1, s1) where p0 = −D1L⁻(q0, q1, s1), with its derivatives.

    D1H⁻ = −q0,    D2H⁻ = −D2L⁻,    D3H⁻ = −D3L⁻  (envelope theorem).

    H⁻ is the right Hamiltonian of L⁻ with the two positions exchanged, at the momentum −p0. H⁻ exists where c ≠ 0 and
    det D1D1L⁻ ≠ 0; NaN elsewhere, and where Newton's method finds no q0.

    Parameters
    ----------
    L_d
        The (right) discrete Lagrangian, from which L⁻ follows.
    near
        (..., n) start of Newton's method for q0, by default q1.

    Source: left discrete Hamiltonian of the paper, with the left Lagrangian of erratum E5.
    """

    def __init__(self, L_d: DiscreteLagrangian, near: Tensor | None = None):
        self.mirror = RightHamiltonian(_Exchanged(LeftLagrangian(L_d)), near)

    def position(self, p0: Tensor, q1: Tensor, s1: Tensor, h: Tensor | float) -> Tensor:
        """q0 with D1L⁻(q0, q1, s1) = −p0, without a graph; shape (..., n), NaN where there is none."""
        return self.mirror.position(q1, -p0, s1, h)

    def __call__(self, p0: Tensor, q1: Tensor, s1: Tensor, h: Tensor | float) -> Tensor:
        """H⁻, shape (...); once differentiable."""
        return self.mirror(q1, -p0, s1, h)

    def partials(self, p0: Tensor, q1: Tensor, s1: Tensor, h: Tensor | float, order: int = 1) -> Partials:
        """H⁻ and its derivatives with respect to (p0, q1, s1)."""
        P = _exchanged(self.mirror.partials(q1, -p0, s1, h, order))
        first = (P.L, -P.D1, P.D2, P.D3)
        if order == 1:
            return Partials(*first)
        return Partials(*first, D11=P.D11, D12=-P.D12, D22=P.D22, D13=-P.D13, D23=P.D23, D33=P.D33)


class _Exchanged:
    """L⁻ as a function of (q1, q0, s)."""

    def __init__(self, of: LeftLagrangian):
        self.of = of

    def __call__(self, q1: Tensor, q0: Tensor, s: Tensor, h: Tensor) -> Tensor:
        return self.of(q0, q1, s, h)

    def partials(self, q1: Tensor, q0: Tensor, s: Tensor, h: Tensor, order: int = 1) -> Partials:
        return _exchanged(self.of.partials(q0, q1, s, h, order))


def _exchanged(P: Partials) -> Partials:
    D12 = P.D12 if P.D12 is None else P.D12.mT
    return Partials(P.L, P.D2, P.D1, P.D3, P.D22, D12, P.D11, P.D23, P.D13, P.D33)
