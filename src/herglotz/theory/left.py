"""Discrete Hamiltonian dynamics: the left discrete Lagrangian L⁻(q0, q1, s1) = s1 − s0(q0, q1, s1) (erratum E5)."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.newton import find_root
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials


class LeftLagrangian:
    """L⁻(q0, q1, s1) = s1 − s0, where s0 + L_d(q0, q1, s0) = s1.

    1 − D3L⁻ = 1/c,    p0 = −D1L⁻,    p1 = D2L⁻ / (1 − D3L⁻).

    Newton's method solves the scalar equation from s0 = s1. The slope of the equation is c: the solution is unique if
    c > 0 for every s0. Value and derivatives are NaN where c = 0 or no solution is found; `regularity` names the cause.

    Parameters
    ----------
    L_d
        The (right) discrete Lagrangian.

    Source: erratum E5, for the paper's L_d(q_k, q_{k+1}, s_{k+1}) in the left discrete Hamiltonian.
    """

    def __init__(self, L_d: DiscreteLagrangian):
        self.L_d = L_d

    def previous_action(
        self,
        q0: Tensor,  # (..., n)
        q1: Tensor,  # (..., n)
        s1: Tensor,  # (...)
        h: Tensor | float,
    ) -> Tensor:
        """s0 with s0 + L_d(q0, q1, s0) = s1, shape (...), without a graph; NaN where no s0 exists."""

        def equations(x: Tensor) -> tuple[Tensor, Tensor]:
            P = partials(self.L_d, q0, q1, x[..., 0], h)
            return (x[..., 0] + P.L - s1)[..., None], P.c[..., None, None]

        with torch.no_grad():
            q0, q1, s1 = q0.detach(), q1.detach(), s1.detach()
            shape = torch.broadcast_shapes(q0.shape[:-1], q1.shape[:-1], s1.shape, torch.as_tensor(h).shape)
            return find_root(equations, s1.expand(shape)[..., None]).solved[..., 0]

    def __call__(self, q0: Tensor, q1: Tensor, s1: Tensor, h: Tensor | float) -> Tensor:
        """L⁻, shape (...), three times differentiable: the graph holds two Newton steps of value zero."""
        s0 = self.previous_action(q0, q1, s1, h)
        if torch.is_grad_enabled():
            for _ in range(2):
                P = partials(self.L_d, q0, q1, s0, h)
                s0 = s0 - (s0 + P.L - s1) / P.c
        return s1 - s0

    def partials(self, q0: Tensor, q1: Tensor, s1: Tensor, h: Tensor | float, order: int = 1) -> Partials:
        """Value and derivatives of L⁻ with respect to (q0, q1, s1), by the implicit-function theorem.

        With g = ∂s0 = (−D1, −D2, 1)/c, D_aD_b L⁻ = (D_ab + D_a3 g_b + g_a D_b3 + D33 g_a g_b)/c. The attribute `c` of
        the result is 1 + D3L⁻; the conformal factor is 1/(1 − D3L⁻). Raise InputError if L_d comes with forces, which
        have no left Lagrangian.
        """
        s0 = self.previous_action(q0, q1, s1, h)
        P = unforced(partials(self.L_d, q0, q1, s0, h, order))
        c = P.c
        g1, g2, g3 = -P.D1 / c[..., None], -P.D2 / c[..., None], 1 / c
        first = (s1 - s0, -g1, -g2, 1 - g3)
        if order == 1:
            return Partials(*first)

        def block(D: Tensor, a3: Tensor, a: Tensor, b3: Tensor, b: Tensor) -> Tensor:
            outer = a3[..., :, None] * b[..., None, :] + a[..., :, None] * (b3 + P.D33[..., None] * b)[..., None, :]
            return (D + outer) / c[..., None, None]

        return Partials(
            *first,
            D11=block(P.D11, P.D13, g1, P.D13, g1),
            D12=block(P.D12, P.D13, g1, P.D23, g2),
            D22=block(P.D22, P.D23, g2, P.D23, g2),
            D13=(P.D13 + P.D33[..., None] * g1) * (g3 / c)[..., None],
            D23=(P.D23 + P.D33[..., None] * g2) * (g3 / c)[..., None],
            D33=P.D33 * g3**2 / c,
        )


def unforced(P: Partials) -> Partials:
    """Return P. Raise InputError if P has forces, which are not derivatives of an action."""
    if P.force is not None:
        raise InputError("this L_d comes with forces F⁻, F⁺; actions and discrete Hamiltonians need one without")
    return P
