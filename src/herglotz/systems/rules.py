"""Quadrature rules: a continuous Lagrangian L(q, v, s) becomes a discrete one, L_d(q0, q1, s0, h).

With v = (q1 − q0)/h and q̄ = (q0 + q1)/2. Once there is damping the order depends on *where s is taken*: midpoint or
trapezoid with plain s0 is of order 1 (trap 1 of `mathematics.md`); the two Heun forms and the implicit midpoint are of
order 2, `left` of order 1.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.systems.special import as_step

Lagrangian = Callable[[Tensor, Tensor, Tensor], Tensor]
Rule = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]

MAX_NEWTON = 30


def left(L: Lagrangian) -> Rule:
    """L_d = h L(q0, v, s0): order 1, c = 1 + h L_s, which vanishes at h = 1/γ for the linear damping L_s = −γ."""

    def L_d(q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        h = as_step(h, q0)
        return h * L(q0, _velocity(q0, q1, h), s0)

    return L_d


def midpoint(L: Lagrangian) -> Rule:
    """L_d = h L(q̄, v, s0 + L_d/2), implicit in one scalar: order 2, c = (1 + hL_s/2)/(1 − hL_s/2) for linear damping.

    The scalar equation is solved by Newton's method from 0, outside the graph; two further Newton steps inside it make
    derivatives exact up to the third (each step doubles the number of correct Taylor coefficients, plus one).
    Where Newton does not converge the value is NaN.
    """

    def L_d(q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        h = as_step(h, q0)
        q, v = 0.5 * (q0 + q1), _velocity(q0, q1, h)

        def action(increment: Tensor, s: Tensor) -> Tensor:
            return h * L(q, v, s + 0.5 * increment)

        increment, converged = _solve_scalar(action, s0, torch.broadcast_shapes(q.shape[:-1], s0.shape, h.shape))
        with torch.set_grad_enabled(action(increment, s0).requires_grad):  # no graph where none was asked for
            for _ in range(2):
                increment = _newton_step(action, increment, s0)
        return torch.where(converged, increment, torch.nan)

    return L_d


def midpoint_heun(L: Lagrangian) -> Rule:
    """L_d = h L(q̄, v, s0 + (h/2) L(q̄, v, s0)): order 2, explicit."""

    def L_d(q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        h = as_step(h, q0)
        q, v = 0.5 * (q0 + q1), _velocity(q0, q1, h)
        return h * L(q, v, s0 + 0.5 * h * L(q, v, s0))

    return L_d


def trapezoid_heun(L: Lagrangian) -> Rule:
    """L_d = (h/2) [L(q0, v, s0) + L(q1, v, s0 + h L(q0, v, s0))]: order 2, explicit.

    The second stage has the Euler value of s1; its O(h²) error enters L_d at O(h³), which order 2 allows.
    """

    def L_d(q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        h = as_step(h, q0)
        v = _velocity(q0, q1, h)
        start = L(q0, v, s0)
        return 0.5 * h * (start + L(q1, v, s0 + h * start))

    return L_d


RULES: dict[str, Callable[[Lagrangian], Rule]] = {
    "left": left,
    "midpoint": midpoint,
    "midpoint_heun": midpoint_heun,
    "trapezoid_heun": trapezoid_heun,
}


def all_rules(L: Lagrangian) -> dict[str, Rule]:
    """Every rule of this module applied to L, by name."""
    return {name: rule(L) for name, rule in RULES.items()}


def _velocity(q0: Tensor, q1: Tensor, h: Tensor) -> Tensor:
    return (q1 - q0) / h[..., None]


ScalarMap = Callable[[Tensor, Tensor], Tensor]


def _newton_step(action: ScalarMap, increment: Tensor, s0: Tensor) -> Tensor:
    """One Newton step for x = action(x, s0), with ∂action/∂x = ½ ∂action/∂s0; in the graph where gradients are on."""
    graph = torch.is_grad_enabled()
    with torch.enable_grad():
        s = s0.expand_as(increment) * 1  # a node of its own, to differentiate the action by it alone
        s = s if s.requires_grad else s.requires_grad_()
        value = action(increment, s)
        slope = torch.zeros_like(increment)
        if value.requires_grad:
            (slope,) = torch.autograd.grad(
                value.sum(), s, create_graph=graph, retain_graph=True, materialize_grads=True, allow_unused=True
            )
        stepped = increment + (value - increment) / (1.0 - 0.5 * slope)
    return stepped if graph else stepped.detach()


def _solve_scalar(action: ScalarMap, s0: Tensor, shape: torch.Size) -> tuple[Tensor, Tensor]:
    """Solve x = action(x, s0) by Newton from 0, outside the graph.

    Returns
    -------
    tuple of Tensor
        The solution (to √eps, which the callers' last steps square) and whether it converged, both of `shape`.
    """
    with torch.no_grad():
        tolerance = torch.finfo(s0.dtype).eps ** 0.5
        increment = s0.new_zeros(shape)
        converged = torch.zeros(shape, dtype=torch.bool, device=s0.device)
        for _ in range(MAX_NEWTON):
            stepped = _newton_step(action, increment, s0)
            converged = (stepped - increment).abs() <= tolerance * (stepped.abs() + s0.abs())
            increment = stepped
            if bool(converged.all()):
                break
    return increment, converged
