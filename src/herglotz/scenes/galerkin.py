"""Galerkin–Lobatto discrete Lagrangians of order 4 and 6.

The motion over a step is a polynomial through its values at the Lobatto nodes; s is collocated there (Lobatto IIIA) and
the values inside the step make the action stationary:

    S_i = s0 + h Σ_j a_ij L(Q_j, V_j, S_j),   V_i = (1/h) Σ_j d_ij Q_j,   L_d = ext_Q h Σ_j b_j L(Q_j, V_j, S_j).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import Partials, autograd_partials
from herglotz.mechanics.newton import attached, find_root, solve
from herglotz.scenes.special import as_step
from herglotz.theory.continuous import Lagrangian, jacobian

MAX_NEWTON = 30  # ends a scalar equation without a solution
# With the Jacobian held fixed each Newton step inside the graph makes derivatives exact one order further.
EXACT_DERIVATIVES = 3


def fixed_point(
    g: Callable[[Tensor], Tensor],  # (..., k) → (..., k), samples apart
    start: Tensor,  # (..., k) of the full batch shape
) -> Tensor:
    """The solution x of x = g(x) by Newton's method from `start`, shape (..., k); NaN where it has not converged.

    Solved outside the graph. Where gradients are on and g wants them, further steps inside the graph carry the first
    three derivatives of x with respect to whatever g depends on.
    """
    start = start.detach()
    eye = torch.eye(start.shape[-1], dtype=start.dtype, device=start.device)

    def equations(x: Tensor) -> tuple[Tensor, Tensor]:
        value, slope = jacobian(g, x)
        return x - value, eye - slope

    # The move after one below √eps is below rounding.
    root = find_root(
        equations, start, 1.0 + start.abs(), iterations=MAX_NEWTON, tol=torch.finfo(start.dtype).eps ** 0.5
    )
    x = root.x + root.move
    if torch.is_grad_enabled() and g(x).requires_grad:
        for _ in range(EXACT_DERIVATIVES):
            x = x - solve(root.J, x - g(x))
    return torch.where(root.converged[..., None], x, torch.nan)


ROOT5 = 5.0**0.5  # of the inner nodes of order 6
# Gauss–Lobatto nodes on [0, 1]: with k of them the quadrature, and here the integrator, has order 2k − 2.
NODES = {4: (0.0, 0.5, 1.0), 6: (0.0, 0.5 - 0.1 * ROOT5, 0.5 + 0.1 * ROOT5, 1.0)}


def collocation(nodes: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """The integration matrix a_ij = ∫_0^{c_i} l_j and the derivative matrix d_ij = l_j′(c_i), each (k, k)."""
    c = torch.tensor(nodes, dtype=torch.float64)
    powers = torch.arange(len(nodes), dtype=torch.float64)
    to_polynomial = torch.linalg.inv(c[:, None] ** powers)  # nodal values → coefficients of 1, x, x², …
    integral = c[:, None] ** (powers + 1) / (powers + 1)
    derivative = powers * c[:, None] ** (powers - 1).clamp_min(0.0)
    return integral @ to_polynomial, derivative @ to_polynomial


@dataclass(frozen=True)
class GalerkinLobatto:
    """L_d of order 4 (3 nodes) or 6 (4 nodes) for any regular L(q, v, s), implicit inside; its own adjoint.

    The positions inside the step are found by Newton's method from the straight line; where it does not converge the
    result is NaN. At a stationary point the first derivatives are those of the action with the inside held fixed, and
    the second ones its Schur complement. Results can be differentiated once more.

    Source: trap 1 of `docs/mathematics.md`.
    """

    L: Lagrangian
    order: int

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Return L_d, shape (...)."""
        h = as_step(h, q0)
        z, _ = self._stationary(q0, q1, s0, h)
        return self._action(z, z, s0.expand(z.shape[:-1]), h)

    def partials(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int = 1) -> Partials:
        """Value, gradient and Hessian blocks."""
        h = as_step(h, q0)
        n = q0.shape[-1]
        z, P = self._stationary(q0, q1, s0, h, second=order == 2)
        first = (P.L, P.D1[..., :n], P.D1[..., -n:], P.D3)
        if order == 1:
            return Partials(*first)
        inside, ends = slice(n, -n), [*range(n), *range(z.shape[-1] - n, z.shape[-1])]
        # Derivatives in (q0, q1, s0) at fixed Q, minus what the motion of Q takes away.
        mixed = torch.cat([P.D11[..., inside, ends], P.D13[..., inside, None]], -1)
        moved = mixed.mT @ torch.linalg.solve_ex(P.D11[..., inside, inside], mixed)[0]
        W = P.D11[..., ends, :][..., ends] - moved[..., :-1, :-1]
        D3z = P.D13[..., ends] - moved[..., :-1, -1]
        return Partials(
            *first,
            D11=W[..., :n, :n],
            D12=W[..., :n, n:],
            D22=W[..., n:, n:],
            D13=D3z[..., :n],
            D23=D3z[..., n:],
            D33=P.D33 - moved[..., -1, -1],
        )

    def _action(self, z: Tensor, _: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """Σ_j h b_j L(Q_j, V_j, S_j) at given positions z = (Q_0, …, Q_end) of all nodes, (..., k·n)."""
        nodes = NODES[self.order]
        integrate, differentiate = (x.to(z) for x in collocation(nodes))
        Q = z.unflatten(-1, (len(nodes), -1))
        V = differentiate @ Q / h[..., None, None]

        def increments(S: Tensor) -> Tensor:  # the collocated S_i − s0
            return h[..., None] * (self.L(Q, V, s0[..., None] + S) @ integrate.mT)

        return fixed_point(increments, z.new_zeros(*z.shape[:-1], len(nodes)))[..., -1]

    def _stationary(
        self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, second: bool = False
    ) -> tuple[Tensor, Partials]:
        """Positions z of all nodes with ∂action/∂Q = 0 inside, and the partials of the action there (q0 stands for z).

        z depends on the arguments through one Newton step in the graph. That is enough for the third derivatives of
        L_d: the action is stationary, so an error in the second derivative of Q does not enter them.
        """
        n, c = q0.shape[-1], torch.tensor(NODES[self.order], dtype=q0.dtype, device=q0.device)
        shape = torch.broadcast_shapes(q0.shape[:-1], q1.shape[:-1], s0.shape, h.shape)
        q0, q1, s0 = q0.expand(*shape, n), q1.expand(*shape, n), s0.expand(shape)
        start = (q0[..., None, :] + c[1:-1, None] * (q1 - q0)[..., None, :]).flatten(-2).detach()

        def equations(inside: Tensor) -> tuple[Tensor, Tensor]:
            P = self._derivatives(q0, inside, q1, s0, h, 2)
            return P.D1[..., n:-n], P.D11[..., n:-n, n:-n]

        with torch.no_grad():
            scale = 1.0 + torch.maximum(q0.abs().amax(-1, keepdim=True), q1.abs().amax(-1, keepdim=True))
            tol = torch.finfo(q0.dtype).eps ** 0.5  # the move after one below √eps is below rounding
            root = find_root(equations, start, scale.expand_as(start), iterations=MAX_NEWTON, tol=tol)
            inside = torch.where(root.converged[..., None], root.x + root.move, torch.nan)
            P = self._derivatives(q0, inside, q1, s0, h, 2)
        if torch.is_grad_enabled():
            F = self._derivatives(q0, inside, q1, s0, h, 1).D1[..., n:-n]
            if F.requires_grad:  # an argument, or a parameter of L
                inside = attached(inside, P.D11[..., n:-n, n:-n], F)
                P = self._derivatives(q0, inside, q1, s0, h, 1 + second)
        return torch.cat([q0, inside, q1], -1), P

    def _derivatives(self, q0: Tensor, inside: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int) -> Partials:
        z = torch.cat([q0, inside, q1], -1)
        return autograd_partials(self._action, z, z.new_zeros(()).expand_as(z), s0, h, order)


def lobatto4(L: Lagrangian) -> GalerkinLobatto:
    """Galerkin–Lobatto with 3 nodes: order 4."""
    return GalerkinLobatto(L, 4)


def lobatto6(L: Lagrangian) -> GalerkinLobatto:
    """Galerkin–Lobatto with 4 nodes: order 6."""
    return GalerkinLobatto(L, 6)
