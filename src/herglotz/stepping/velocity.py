"""Velocities in and out: the Legendre transform p = L_v(q, v, s) at a point of a motion, and its inverse.

A model has its Lagrangian L = lim L_d(q, q + hv, s, h)/h, and L_v in closed form: p of a step of order 2 or 4 is L_v to
that order, and v has the same order. The forces of a step act in halves and leave p = L_v. Only set-valued dry friction
acts in F⁻ as a whole (`herglotz.models.friction`), so p lacks half an impulse of friction:

    p ∈ L_v(q, v, s) + (h/2) r(q, v) Sgn(v),

with r the largest force. The inverse is an inclusion like a step, and `herglotz.stepping.newton.StickSlip` solves the
inclusion: v = 0 where friction can hold p. For any other L_d, p is the mean of both discrete transforms of a step,

    p = ½ (FL⁻p + FL⁺p) of (q − hv/2, q + hv/2, s − L_d/2),

which is L_v to order 2 in h. Source: J. E. Marsden & M. West, Discrete mechanics and variational integrators (2001),
section 1.6: the exact L_d has FL⁻ and FL⁺ of L; section 1 of `docs/mathematics.md` for the factor c.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.mechanics import DiscreteLagrangian, Forces, Partials, momentum_jacobian, momentum_residual, partials
from herglotz.mechanics.contact import jacobian
from herglotz.mechanics.legendre import momentum_minus, momentum_plus
from herglotz.mechanics.newton import Point, attached
from herglotz.models import ContactLagrangian
from herglotz.models.capabilities import DrivenLagrangian
from herglotz.stepping.equation import End
from herglotz.stepping.newton import find_root, status_of
from herglotz.stepping.state import State, Status

# Tolerance in machine epsilons of v, and bound on Newton iterations, both as those of a step.
TOL, MAX_ITERATIONS = 4, 30
# Number of samples solved together: second derivatives of many coordinates fill the memory.
CHUNK = 4096


class Legendre(NamedTuple):
    """The Legendre transform at (q, v, s)."""

    p: Tensor  # (..., n) L_v, without dry friction
    by_v: Tensor  # (..., n, n) L_vv
    grip: Tensor | None = None  # (..., n) (h/2) r(q, v) where dry friction is set-valued
    grip_by_v: Tensor | None = None  # (..., n) its slope


# (q, v, s, h) → `Legendre`: that of an L_d, `partial(legendre, L_d)`, or of a file
Transform = Callable[[Tensor, Tensor, Tensor, Tensor], Legendre]


def momentum(transform: Transform, q: Tensor, v: Tensor, s: Tensor, h: Tensor) -> Tensor:
    """The momentum p (..., n) of a motion through q at v, (..., n), with s (...) and steps h, () or (...)."""
    there = transform(q, v, s, h)
    return there.p if there.grip is None else there.p + there.grip * v.sign()


def velocity(transform: Transform, state: State, h: Tensor) -> tuple[Tensor, Tensor]:
    """The v (..., n) of states with steps h, () or (...), and the `Status` of each, (...); NaN where none was found.

    Differentiable once, by the implicit-function theorem.
    """
    batch, n = state.s.shape, state.q.shape[-1]
    flat = State(state.q.reshape(-1, n), state.p.reshape(-1, n), state.s.reshape(-1))
    h = h.expand(batch).reshape(-1)
    parts = zip(*(x.split(CHUNK) for x in (*flat, h)), strict=True)
    v, status = zip(*(_velocity(transform, State(*x), h) for *x, h in parts), strict=True)
    return torch.cat(v).reshape(state.q.shape), torch.cat(status).reshape(batch)


def velocities(L_d: DiscreteLagrangian, state: State, h: Tensor) -> Tensor:
    """The v (..., n) of states with steps h, () or (...), the step that led to each state.

    NaN where a state is not finite or has no velocity.
    """
    reached = state.finite
    v = torch.full_like(state.q, torch.nan)
    if bool(reached.any()):
        v[reached] = velocity(
            partial(legendre, L_d), State(*(x[reached] for x in state)), h.to(state.s).expand(state.s.shape)[reached]
        )[0]
    return v


def legendre(L_d: DiscreteLagrangian, q: Tensor, v: Tensor, s: Tensor, h: Tensor) -> Legendre:
    """The momentum and its derivatives by v; see the head of this module."""
    model = L_d.model if isinstance(L_d, DrivenLagrangian) else L_d
    if not isinstance(model, ContactLagrangian):
        return _symmetric(L_d, q, v, s, h)
    p, by_v = model.velocity_derivatives(q, v, s)
    if model.friction is None or not model.friction.sticking:
        return Legendre(p, by_v)
    more = None if model.drag is None else model.drag.held(q)
    grip, slope = model.friction.grip(v, 0.0 if more is None else more[0])
    return Legendre(p, by_v, (h / 2)[..., None] * grip, (h / 2)[..., None] * slope)


def _symmetric(L_d: DiscreteLagrangian, q: Tensor, v: Tensor, s: Tensor, h: Tensor) -> Legendre:
    """The mean of FL⁻ and FL⁺ over a step with q in its middle."""

    def mean(v: Tensor) -> Tensor:
        half = (h / 2)[..., None] * v
        q0, q1 = q - half, q + half
        P = partials(L_d, q0, q1, s - partials(L_d, q0, q1, s, h).L / 2, h)
        return (momentum_minus(P) + momentum_plus(P)) / 2

    return Legendre(*jacobian(mean, v))


class _AtVelocity:
    """L_v(q, v, s) = p as a step equation in v: F = p − L_v, with the impulse of dry friction as in a step."""

    increments = True

    def __init__(self, transform: Transform, state: State, h: Tensor):
        self.transform, self.state, self.h = transform, state, h
        self.q0, self.p0 = torch.zeros_like(state.q), state.p
        self.sticking = transform(state.q, self.q0, state.s, h).grip is not None

    def __call__(self, x: Tensor, second: bool) -> Point:  # noqa: ARG002  one signature for all
        """F and ∂F/∂v at v = x."""
        q, _, s = self.state
        found, zero = self.transform(q, x, s, self.h), torch.zeros_like(s)
        force = None
        if found.grip is not None and found.grip_by_v is not None:
            held = torch.where(x.abs() > 0, 0.0, found.grip)
            slope = torch.diag_embed(-found.grip_by_v * x.sign())
            force = Forces(-found.grip * x.sign(), zero, minus_2=slope, held=held, grip=found.grip)
        none = torch.zeros_like(x)
        P = Partials(zero, -found.p, none, zero, D12=-found.by_v, D23=none, force=force)
        return Point(momentum_residual(P, self.p0), momentum_jacobian(P, self.p0), P)

    def push(self, point: Point) -> Tensor:  # noqa: ARG002  one signature for all
        """See `StepEquation`."""
        return self.p0

    def end(self, x: Tensor, point: Point) -> End:  # noqa: ARG002
        """See `StepEquation`."""
        return End(self.p0, point.rest.L, point.rest.c)

    def typical_increment(self) -> Tensor:
        """The size of positions over h: v of an L_d that is no model has the rounding of their difference."""
        return self.state.q.abs().amax(-1) / self.h


def _velocity(transform: Transform, state: State, h: Tensor) -> tuple[Tensor, Tensor]:
    """`velocity` of a chunk (B, n)."""
    equation = _AtVelocity(transform, state, h)
    with torch.no_grad():
        tol = TOL * torch.finfo(state.q.dtype).eps
        found = find_root(equation, equation.q0, tol, MAX_ITERATIONS, 2)
        status, good = status_of(found, equation.end(found.x, found.point))
    v = found.x
    if torch.is_grad_enabled() and (F := equation(v, True).F).requires_grad:
        v = attached(v, found.point.J, F)
    return v if good else torch.where((status == Status.CONVERGED)[..., None], v, torch.nan), status
