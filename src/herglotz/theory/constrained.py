"""Beyond the paper: holonomic constraints g(q) = 0 on the steps of any L_d (RATTLE with the conformal factor).

    c p_k + D1 L_d(q_k, q_{k+1}, s_k) = Dg(q_k)ᵀλ,    g(q_{k+1}) = 0        solved for (q_{k+1}, λ)
    p_{k+1} = D2 L_d + Dg(q_{k+1})ᵀμ,                 Dg · v(q_{k+1}, p_{k+1}, s_{k+1}) = 0

with the velocity v = H_p. The projection by μ changes the next λ and no position. The momentum J of a symmetry of L_d
and g obeys J_{k+1} = c_k J_k, as without constraints.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import (
    DiscreteLagrangian,
    momentum_plus,
    momentum_residual,
    partials,
)
from herglotz.mechanics.contact import jacobian
from herglotz.mechanics.newton import Root, find_root
from herglotz.stepping.rollout import OneStepMethod
from herglotz.stepping.state import State, Step, check_h, check_state, status_of_root

# g(q), (..., n) → (..., m).
Constraint = Callable[[Tensor], Tensor]
# v(q, p, s), shape (..., n).
Velocity = Callable[[Tensor, Tensor, Tensor], Tensor]

# Newton steps for μ. One step is enough for a velocity linear in p; the limit matters for nonlinear velocities alone.
MAX_PROJECTION_STEPS = 20


class ConstrainedStepper(OneStepMethod):
    """Φ̃ on the constraint manifold {g = 0, Dg·v = 0}.

    Parameters
    ----------
    L_d
        Discrete Lagrangian in the ambient coordinates.
    constraint
        g(q), (..., n) → (..., m), differentiable by autograd. The rows of Dg must be independent where g vanishes.
    velocity
        v = H_p(q, p, s), (..., n), e.g. a scene's; for a constant mass p / m.

    Source: section 6 of `docs/mathematics.md`.
    """

    iterates = True

    def __init__(self, L_d: DiscreteLagrangian, constraint: Constraint, velocity: Velocity):
        self.L_d, self.constraint, self.velocity = L_d, constraint, velocity

    def project(self, state: State) -> State:
        """Return (q, p + Dgᵀμ, s) with Dg·v = 0: the state with its momentum projected on the tangent space."""
        q, p, s = check_state(state)
        return State(q, self._projected(q, p, s), s)

    def step(self, state: State, h: Tensor | float, guess: Tensor | None = None) -> Step:
        """One step: solve for (q1, λ) → momentum → projection → action.

        The state has g(q) = 0; a p off the tangent space gives the same step as its projection. `guess` is near q1, by
        default q + h v. The step is once differentiable with respect to the state, h and the parameters of L_d. Raise
        InputError if shapes or dtypes do not fit or h is not positive.
        """
        state = check_state(state)
        h = check_h(h, state.q)
        q1, _, root = self._solve(state, h, guess)
        P = partials(self.L_d, state.q, q1, state.s, h)
        s1 = state.s + P.L
        p1 = self._projected(q1, momentum_plus(P), s1)
        # If Dg loses rank, the saddle-point matrix or the matrix of the projection is singular.
        end = torch.isfinite(p1).all(-1) & torch.isfinite(s1)
        singular = (P.c == 0) | (root.converged & ~end)
        status = status_of_root(root, torch.isfinite(root.x).all(-1), singular)
        return Step.of(State(q1, p1, s1), P.c, status, root.error, root.iterations)

    def multiplier(self, state: State, h: Tensor | float) -> Tensor:
        """Return λ of one step, (..., m). 2λ/h tends to the constraint's force: half an impulse acts at each end."""
        state = check_state(state)
        return self._solve(state, check_h(h, state.q), None)[1]

    def _rows(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """The constraint g(q) and its derivative Dg(q), shapes (..., m) and (..., m, n)."""
        g, Dg = jacobian(self.constraint, q)
        if g.shape[:-1] != q.shape[:-1] or not 0 < g.shape[-1] < q.shape[-1]:
            raise InputError(
                f"constraint must map (..., {q.shape[-1]}) to (..., m) with 0 < m < {q.shape[-1]}; "
                f"it gave {tuple(g.shape)} for {tuple(q.shape)}"
            )
        return g, Dg

    def _solve(self, state: State, h: Tensor, guess: Tensor | None) -> tuple[Tensor, Tensor, Root]:
        """q1 and λ, with their derivatives where gradients are on."""
        q0, p0, s0 = state
        n = q0.shape[-1]
        Dg0 = self._rows(q0)[1]
        m = Dg0.shape[-2]

        def balance(x: Tensor) -> Tensor:
            P = partials(self.L_d, q0, x[..., :n], s0, h)
            left = momentum_residual(P, p0) - (Dg0.mT @ x[..., n:, None])[..., 0]
            return torch.cat([left, self.constraint(x[..., :n])], -1)

        with torch.no_grad():
            if guess is None:
                guess = q0 + h[..., None] * self.velocity(q0, p0, s0)
            start = torch.cat([guess, Dg0.new_zeros(*q0.shape[:-1], m)], -1)
            # λ is a momentum over a slope of g. Its scale is that of the terms that λ balances: at rest, gravity's
            # impulse.
            size = torch.maximum(q0.abs().amax(-1, keepdim=True), (guess - q0).abs().amax(-1, keepdim=True))
            slope = Dg0.abs().amax((-2, -1))[..., None]
            P = partials(self.L_d, q0, guess, s0, h)
            impulse = (P.c[..., None] * p0).abs() + P.D1.abs()
            impulse = (impulse.amax(-1, keepdim=True) / slope).expand_as(start[..., n:])
            scale = torch.cat([size.expand(q0.shape), impulse], -1)
            root = find_root(lambda x: jacobian(balance, x), start, scale)
        x = root.with_slope(balance)
        return x[..., :n], x[..., n:], root

    def _projected(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """The momentum p + Dgᵀμ with Dg·v = 0. Where v is linear in p, one Newton step finds μ."""
        Dg = self._rows(q)[1]

        def missed(mu: Tensor) -> Tensor:
            return (Dg @ self.velocity(q, p + (Dg.mT @ mu[..., None])[..., 0], s)[..., None])[..., 0]

        start = p.new_zeros(*p.shape[:-1], Dg.shape[-2])
        scale = (p.detach().abs().amax(-1) / Dg.detach().abs().amax((-2, -1)))[..., None].expand(start.shape)
        root = find_root(lambda mu: jacobian(missed, mu), start, scale, iterations=MAX_PROJECTION_STEPS)
        mu = root.with_slope(missed)
        return p + (Dg.mT @ mu[..., None])[..., 0]
