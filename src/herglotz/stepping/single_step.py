"""A step of a discrete Lagrangian by the cheapest way that its form allows: closed form, increments, or positions."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import DiscreteLagrangian, Driven, momentum_plus, momentum_residual
from herglotz.mechanics.legendre import regularity
from herglotz.mechanics.newton import Found, attached
from herglotz.stepping.equation import (
    End,
    ModelEquation,
    PartialsEquation,
    StepEquation,
    StepOfModel,
    model_equation,
    partials_at,
)
from herglotz.stepping.explicit import Field, Leapfrog, explicit_status, leapfrog
from herglotz.stepping.newton import find_root, status_of
from herglotz.stepping.state import State, Status, Step

# Steps shorter than this part of a model's time, typical q over typical v, are solved for Δ. Solved for q1, p ~ mΔ/h
# has a relative error of eps/h: measured were 7e-13 at h = 1e-3, 1e-9 at 1e-6 and 1e-3 at 1e-12 of that time.
SHORT = 1e-6


class SingleStep:
    """Steps whose arguments are already checked; keeps the force at the position that consecutive steps share.

    In float32, and at very short h, the unknown is the increment Δ = q1 − q0 if L_d offers increments, and rollouts
    add Δ by compensated summation: q1 − q0 and q0 + Δ would round away a small step.
    """

    def __init__(self, L_d: DiscreteLagrangian, tol: float | None, max_iterations: int, explicit: bool):
        self.L_d, self.tol, self.max_iterations = L_d, tol, max_iterations
        self.leapfrog: Leapfrog | None = leapfrog(L_d) if explicit else None
        # A position, and the potential there.
        self._at: Tensor | None = None
        self._field: Field | None = None
        # The last h, and whether that h is short.
        self._short: tuple[Tensor, bool] | None = None
        # The status and the residual of explicit steps that succeed.
        self._fine: tuple[Tensor, Tensor] | None = None

    @cached_property
    def _terms(self) -> ModelEquation | None:
        """The step equations by terms, for an L_d with known terms."""
        return model_equation(self.L_d)

    def __call__(
        self, state: State, h: Tensor, guess: Tensor | None = None, u: Tensor | None = None, low: State | None = None
    ) -> tuple[Step, State | None]:
        """The step with input u, and its rounding errors; `low` are the rounding errors of the step before."""
        if self.leapfrog is not None:
            return self._explicit(self.leapfrog, state, h, u, low)
        return self._implicit(state, h, state.q if guess is None else guess, u, low)

    def _explicit(
        self, frog: Leapfrog, state: State, h: Tensor, u: Tensor | None, low: State | None
    ) -> tuple[Step, State | None]:
        increments = self._in_increments(state.q, h)
        move = frog(state, h, self._field if self._at is state.q else None, u, increments)
        if move.dp is not None:
            new, low = _compensated(state, State(move.delta, move.dp, move.L), low)
        else:
            new, low = State(move.q1, move.p1, state.s + move.L), None
        with torch.no_grad():
            status = explicit_status(*new, move.c, frog.regular(h))
        good = status is None
        if self._fine is None or self._fine[1].shape != state.s.shape:
            zero = torch.zeros_like(state.s)
            self._fine = zero.to(torch.uint8), zero
        step = _report(new, move.c, self._fine[0] if status is None else status, self._fine[1], 1, good)
        self._at, self._field = step.state.q, move.there
        return step, low

    def _implicit(
        self, state: State, h: Tensor, guess: Tensor, u: Tensor | None, low: State | None
    ) -> tuple[Step, State | None]:
        q0, p0, s0 = state
        L_d = driven_by(self.L_d, u)
        increments = self._in_increments(q0, h) and hasattr(L_d, "partials_increment")
        # The error of q1, divided by h, enters p at every step and adds up: steps are solved to rounding.
        tol = self.tol if self.tol is not None else 4 * torch.finfo(q0.dtype).eps
        order = 2 if torch.is_grad_enabled() else 1
        with torch.no_grad():
            if self._terms is None:
                equation: StepEquation = PartialsEquation(L_d, state, h, order, increments)
            else:
                equation = self._terms.at(state, h, u, increments, self._field if self._at is state.q else None)
            found = find_root(equation, guess, tol, self.max_iterations, order)
            end = equation.end(found.x, found.point)
            status, good = status_of(found, end)
            # The terms of a model have no pole in h.
            if isinstance(equation, PartialsEquation):
                status = _at_pole(L_d, state, h, q0 + found.x if increments else found.x, found, status)
                good = good and not bool(status.any())
        x = found.x
        if order == 2:
            assert found.point.J is not None
            x, end = _attach(L_d, state, h, found.x, found.point.J, increments)
        if increments:
            new, low = _compensated(state, State(x, end.p1 - p0 if end.dp is None else end.dp, end.L), low)
            new = new._replace(p=end.p1) if end.dp is None else new
        else:
            new = State(x, end.p1, s0 + end.L)
        # The equation is solved, but a number of the new state may be too large, or s0 NaN.
        if good:
            with torch.no_grad():
                unseen = explicit_status(*new, end.c, True)
            status, good = (status, True) if unseen is None else (unseen, False)
        step = _report(new, end.c, status, found.residual, found.iterations, good)
        if isinstance(equation, StepOfModel):
            self._at, self._field = step.state.q, equation.there
        return step, low

    def _in_increments(self, q0: Tensor, h: Tensor) -> bool:
        """Whether Δ = q1 − q0 is the unknown: in float32, and where a difference of positions costs p its digits."""
        if self._short is None or self._short[0] is not h:
            config = getattr(self.L_d, "config", None)
            time = 1.0 if config is None else max(config.scale) / max(config.speed)
            self._short = h, bool((h < SHORT * time).any())
        return q0.element_size() < 8 or self._short[1]


def driven_by(L_d: DiscreteLagrangian, u: Tensor | None) -> DiscreteLagrangian:
    """The discrete Lagrangian of a step with input u; raise InputError if there is an input and L_d takes none."""
    if u is None:
        return L_d
    if not isinstance(L_d, Driven):
        raise InputError(f"{type(L_d).__name__} takes no inputs: it has no method `at(u)`; leave the inputs out")
    return L_d.at(u)


def _at_pole(L_d: DiscreteLagrangian, state: State, h: Tensor, q1: Tensor, found: Found, status: Tensor) -> Tensor:
    """The status of every sample, SINGULAR where L_d has a pole at this h: q1 is right there, p1 and s1 are rounding.

    |F| / |J⁻¹F| estimates |J| at no cost, and eps |J| |q| estimates the rounding of p1. L_d is evaluated at neighbours
    of h only if that rounding leaves p1 less than a third of its digits, which also happens for a body almost at rest.
    """
    q0, p0, s0 = state
    size = torch.maximum(q0.abs(), q1.abs()).amax(-1)
    F = found.point.F.abs().amax(-1)
    eps = torch.finfo(F.dtype).eps
    momenta = p0.abs().amax(-1) + found.point.rest.L.abs() / size
    suspect = (eps * size * F > eps ** (1 / 3) * momenta * found.residual) & (status == Status.CONVERGED)
    if not bool(suspect.any()):
        return status
    pole = regularity(L_d, q0, q1, s0, h).lost("pole")
    return torch.where(suspect & pole, torch.full_like(status, Status.SINGULAR), status)


def _attach(
    L_d: DiscreteLagrangian, state: State, h: Tensor, x: Tensor, J: Tensor, increments: bool
) -> tuple[Tensor, End]:
    """Attach the derivative to the solved x: a Newton step of value zero and slope dx = −J⁻¹ dF."""
    q0, p0, s0 = state
    P = partials_at(L_d, q0, x, s0, h, 1, increments)
    F = momentum_residual(P, p0)
    # A sticking coordinate has q1 = q0.
    if P.force is not None and P.force.held is not None and not increments:
        F = F + torch.where(P.force.held > 0, J.diagonal(0, -2, -1) * (x - q0), 0.0)
    if F.requires_grad:
        x = attached(x, J, F)
        P = partials_at(L_d, q0, x, s0, h, 1, increments)
    return x, End(momentum_plus(P), P.L, P.c)


def _compensated(state: State, change: State, low: State | None) -> tuple[State, State]:
    """Kahan's sum state + change, and its rounding error, which is to be added to the next change."""
    wanted = change if low is None else State(*(a + b for a, b in zip(change, low, strict=True)))
    new = State(*(a + b for a, b in zip(state, wanted, strict=True)))
    with torch.no_grad():
        lost = State(*(b - (c - a) for a, b, c in zip(state, wanted, new, strict=True)))
    return new, lost


def _report(new: State, c: Tensor, status: Tensor, residual: Tensor, iterations: int, good: bool) -> Step:
    """The step; `good`: no sample failed."""
    return (Step if good else Step.of)(new, c, status, residual, iterations)
