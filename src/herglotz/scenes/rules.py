"""Quadrature rules: a continuous Lagrangian L(q, v, s) becomes a discrete one, L_d(q0, q1, s0, h).

The rules use v = (q1 − q0)/h and q̄ = (q0 + q1)/2. With damping the order of a rule depends on *where s is taken* (trap
1 of `docs/mathematics.md`); ORDERS has the order of each rule, which a test measures.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian
from herglotz.mechanics.contact import jacobian
from herglotz.mechanics.newton import find_root, solve
from herglotz.mechanics.partials import Lagrangian
from herglotz.scenes.special import as_step

# Ends the iteration of a scalar equation without a solution.
MAX_NEWTON = 30
# With a constant Jacobian each Newton step inside the graph makes derivatives of one more order exact.
EXACT_DERIVATIVES = 3
Rule = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]


def _rule(formula: Callable[..., Tensor]) -> Callable[[Lagrangian], Rule]:
    """The rule L ↦ L_d of a formula of (L, q0, q1, v, s0, h)."""

    def rule(L: Lagrangian) -> Rule:
        def L_d(q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
            h = as_step(h, q0)
            return formula(L, q0, q1, (q1 - q0) / h[..., None], s0, h)

        return L_d

    for name in ("__module__", "__name__", "__qualname__", "__doc__"):
        setattr(rule, name, getattr(formula, name))
    return rule


@_rule
def left(L: Lagrangian, q0: Tensor, q1: Tensor, v: Tensor, s0: Tensor, h: Tensor) -> Tensor:  # noqa: ARG001
    """L_d = h L(q0, v, s0): order 1, c = 1 + h L_s, which vanishes at h = 1/γ for the linear damping L_s = −γ."""
    return h * L(q0, v, s0)


@_rule
def right(L: Lagrangian, q0: Tensor, q1: Tensor, v: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    """L_d = h L(q1, v, s1) with s1 = s0 + L_d, implicit in one scalar: order 1, the adjoint of `left`.

    c = 1/(1 − hL_s) for linear damping.
    """
    return implicit(lambda x: h * L(q1, v, s0 + x), q0, q1, s0, h)


@_rule
def midpoint(L: Lagrangian, q0: Tensor, q1: Tensor, v: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    """L_d = h L(q̄, v, s0 + L_d/2), implicit in one scalar: order 2, c = (1 + hL_s/2)/(1 − hL_s/2) for linear damping.

    The rule is its own adjoint. L_d is NaN where Newton's method for the scalar does not converge.
    """
    q = 0.5 * (q0 + q1)
    return implicit(lambda x: h * L(q, v, s0 + 0.5 * x), q0, q1, s0, h)


@_rule
def midpoint_heun(L: Lagrangian, q0: Tensor, q1: Tensor, v: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    """L_d = h L(q̄, v, s0 + (h/2) L(q̄, v, s0)): order 2, explicit."""
    q = 0.5 * (q0 + q1)
    return h * L(q, v, s0 + 0.5 * h * L(q, v, s0))


@_rule
def midpoint_plain(L: Lagrangian, q0: Tensor, q1: Tensor, v: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    """L_d = h L(q̄, v, s0): order 1 with damping, 2 without. Trap 1, kept to be measured; use `midpoint_heun`."""
    return h * L(0.5 * (q0 + q1), v, s0)


@_rule
def trapezoid(L: Lagrangian, q0: Tensor, q1: Tensor, v: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    """L_d = (h/2) [L(q0, v, s0) + L(q1, v, s0 + L_d)], implicit in one scalar: order 2, its own adjoint.

    c = (1 + hL_s/2)/(1 − hL_s/2) for linear damping.
    """
    start = L(q0, v, s0)
    return implicit(lambda x: 0.5 * h * (start + L(q1, v, s0 + x)), q0, q1, s0, h)


@_rule
def trapezoid_heun(L: Lagrangian, q0: Tensor, q1: Tensor, v: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    """L_d = (h/2) [L(q0, v, s0) + L(q1, v, s0 + h L(q0, v, s0))]: order 2, explicit.

    The second stage has the Euler value of s1, whose O(h²) error enters L_d at O(h³), which order 2 allows.
    """
    start = L(q0, v, s0)
    return 0.5 * h * (start + L(q1, v, s0 + h * start))


@_rule
def trapezoid_plain(L: Lagrangian, q0: Tensor, q1: Tensor, v: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    """L_d = (h/2) [L(q0, v, s0) + L(q1, v, s0)]: order 1 with damping, 2 without. Trap 1, kept to be measured."""
    return 0.5 * h * (L(q0, v, s0) + L(q1, v, s0))


def strang(potential: Callable[[Tensor], Tensor], m: float, gamma: float) -> Rule:
    """L_d = (E−1)s0 + √E [m|Δ|²/2h − (h/2)(V0 + V1)], E = e^{−γh}: order 2, its own adjoint, with an explicit step.

    L_d generates the splitting damp(h/2) ∘ kick(h/2) ∘ drift(h) ∘ kick(h/2) ∘ damp(h/2) of H = |p|²/2m + V(q) + γs into
    γs, V and |p|²/2m, and c = E exactly.
    """

    def L_d(q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        h = as_step(h, q0)
        delta = q1 - q0
        action = 0.5 * m / h * (delta * delta).sum(-1) - 0.5 * h * (potential(q0) + potential(q1))
        return torch.expm1(-gamma * h) * s0 + torch.exp(-0.5 * gamma * h) * action

    return L_d


# Each rule with its order on a damped problem, measured in tests/unit/scenes/test_rules.py.
_MEASURED: tuple[tuple[Callable[[Lagrangian], DiscreteLagrangian], int], ...] = (
    (left, 1), (right, 1), (midpoint, 2), (midpoint_heun, 2), (midpoint_plain, 1), (trapezoid, 2), (trapezoid_heun, 2),
    (trapezoid_plain, 1),
)  # fmt: skip
RULES = {rule.__name__: rule for rule, _ in _MEASURED}
ORDERS = {rule.__name__: order for rule, order in _MEASURED}


def all_rules(L: Lagrangian) -> dict[str, DiscreteLagrangian]:
    """Every rule applied to L, by name."""
    return {name: rule(L) for name, rule in RULES.items()}


def implicit(action: Callable[[Tensor], Tensor], q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
    """The scalar x = action(x) of each sample, by Newton's method from 0; NaN without convergence.

    Newton's method runs outside the graph. If the action requires a gradient, `EXACT_DERIVATIVES` further steps inside
    the graph give x its first three derivatives.
    """
    start = s0.new_zeros(*torch.broadcast_shapes(q0.shape[:-1], q1.shape[:-1], s0.shape, h.shape), 1)

    def missed(x: Tensor) -> Tensor:
        return x - action(x[..., 0])[..., None]

    # After a move below √eps the next move is below rounding.
    tol = torch.finfo(start.dtype).eps ** 0.5
    with torch.no_grad():
        # Units decide nothing: small actions are solved to their own size.
        size = (s0.abs()[..., None] + missed(start).abs()).clamp(max=1.0)
    root = find_root(lambda x: jacobian(missed, x), start, size, iterations=MAX_NEWTON, tol=tol)
    x = root.x + root.move
    # The size is rounding where the terms of an action cancel.
    converged = root.converged | (root.move.abs() <= tol)[..., 0]
    if torch.is_grad_enabled() and missed(x).requires_grad:
        for _ in range(EXACT_DERIVATIVES):
            x = x - solve(root.J, missed(x))
    return torch.where(converged, x[..., 0], torch.nan)
