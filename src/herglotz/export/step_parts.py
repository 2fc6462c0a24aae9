"""One traced step for C, with the potential at both ends as inputs; `herglotz.export.lower.c` cuts it into pieces."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from herglotz.codegen.trace import Graph
from herglotz.export.equation import Equations, example, field_like
from herglotz.mechanics.legendre import soft_threshold
from herglotz.mechanics.newton import Point
from herglotz.models import ContactLagrangian, OwnLagrangian
from herglotz.models.jet import Jet
from herglotz.models.terms import FeatureKinetic, PositionKinetic, Potential
from herglotz.stepping import State
from herglotz.stepping.equation import PartialsEquation, model_equation
from herglotz.stepping.explicit import Field, Leapfrog
from herglotz.stepping.newton import StickSlip, at_rest
from herglotz.stepping.single_step import driven_by

# The potential at q0 and q1.
Ends = tuple[Field, Field]
# The results of `StepParts`.
Parts = tuple[Tensor, ...]


def step_parts(equations: Equations) -> Graph:
    """`StepParts` as a graph."""
    q, p, s, h, *u = example(equations.model, 0.1)
    V, slope = field_like(q)
    more = (V, slope, 0.1 * p, 0.2 * p, V + 1, slope + 1)
    return equations.traced(StepParts(equations.model), (q, p, s, h, *more, *u))


def pushed(model: ContactLagrangian) -> ContactLagrangian:
    """The model with generalised forces as inputs: G becomes the unit matrix, u₀ becomes 0. Changed in place.

    Where inputs act through the position, they stand before the forces.
    """
    friction, n = model.friction, model.config.dof
    if model.config.inputs and friction is not None:
        m = model.config.inputs if model.capabilities.inputs_by_position else 0
        model.config = replace(model.config, inputs=m + n, input_map=())
        friction.inputs, friction.input_zero = m + n, None
        del friction.input_map
        friction.register_buffer("input_map", torch.eye(m + n).to(friction.viscous)[m:])
    return model


class GivenPotential(nn.Module):
    """A potential whose values and slopes at q0 and q1 are given; its second derivatives are 0 and never read."""

    def __init__(self, potential: Potential, ends: Ends):
        super().__init__()
        self.features = potential.features
        self.ends = ends

    def forward(self, q: Tensor, order: int) -> Jet:
        """The jets at (q0, q1), (2, B, n)."""
        n = q.shape[-1]
        rows = [torch.stack([end.V for end in self.ends])[None]]
        rows.append(torch.stack([end.slope for end in self.ends]).movedim(-1, 0))
        if order == 2:
            rows.append(q.new_zeros(n * (n + 1) // 2, *q.shape[:-1]))
        return Jet(torch.cat(rows), n, order)


class StepParts:
    """The terms of a step, for `herglotz.export.lower.c`.

    Where the step is explicit, the guess is the solution, and J is 0.
    """

    def __init__(self, model: ContactLagrangian):
        self.model = model

    def __call__(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        """The guess of Δ, F and J at the trial, and p1 − p0, s1 − s0 and c − 1.

        The arguments are q, p (B, n), s, h (B,), V0 (B,) and V′ (B, n) at q0, a trial Δ = q1 − q0 and the exact Δ near
        the trial (B, n), V1 and V′ at q1, and u (B, m) where the model takes inputs. Where dry friction can hold a
        coordinate, Δ stands for the z of `herglotz.stepping.newton`, and w/K is a last result.
        """
        (q, p, s, h, V0, slope0, delta, x, V1, slope1), u = arguments[:10], arguments[10:]
        ends = Field(V0, slope0), Field(V1, slope1)
        known = self.model.capabilities
        form = self._explicit if known.explicit else self._by_terms if known.by_terms else self._by_jets
        if known.sticking:
            form = self._by_sticking
        guess, F, J, dp, L, E, *bound = form(State(q, p, s), h, ends, delta, x, u[0] if u else None)
        return *(y.clone() for y in (guess, F, J, dp, L)), E.expand(s.shape).clone(), *bound

    def _explicit(self, state: State, h: Tensor, ends: Ends, delta: Tensor, _: Tensor, u: Tensor | None) -> Parts:
        frog = Leapfrog(self.model, field=lambda _: ends[1])
        move = frog(state, h, ends[0], u, True)
        assert move.dp is not None
        maker = model_equation(self.model, fold=False)
        assert maker is not None
        # FL⁺ needs F; the step itself does not.
        F = maker.at(state, h, u, True, ends[0])(delta, False).F
        J = F[..., None] * torch.zeros_like(F)[..., None, :]
        return move.delta, F, J, move.dp, move.L, frog.constants(h).c_minus_1

    def _by_terms(self, state: State, h: Tensor, ends: Ends, delta: Tensor, x: Tensor, u: Tensor | None) -> Parts:
        maker = model_equation(self.model, fold=False)
        assert maker is not None
        maker.field = lambda _: ends[1]  # pyright: ignore[reportAttributeAccessIssue]
        form = maker.at(state, h, u, True, ends[0])
        point = form(delta, True)
        v, mv, N, damping, force = form.at(x, point).rest
        if self.model.friction is not None:
            # Dry friction is steep near rest, so it is evaluated at the exact velocity.
            force = self.model.friction.value_and_slope(v, u)[0]
        end = form.end(x, Point(point.F, point.J, (v, mv, N, damping, force)))
        E = form.constants.c_minus_1 if damping is None else damping[1]
        dp = end.dp
        if dp is None:
            # F at the trial is not quite 0: the move from the trial to x adds F to p1.
            dp = (form.end(delta, point).p1 + point.F) - state.p
        assert point.J is not None
        return form.leap(), point.F, point.J, dp, end.L, E

    def _by_jets(self, state: State, h: Tensor, ends: Ends, delta: Tensor, x: Tensor, u: Tensor | None) -> Parts:
        with self._given(ends):
            form = PartialsEquation(driven_by(self.model, u), state, h, 1, increments=True)
            point = form(delta, True)
        end = form.end(delta, point)
        # F at the trial is not quite 0, as in `_by_terms`.
        dp = (end.p1 + point.F) - state.p
        assert point.J is not None
        guess = self._leap(state, h, ends[0])
        return guess, point.F, point.J, dp, end.L + (end.p1 * (x - delta)).sum(-1), point.rest.D3

    def _by_sticking(self, state: State, h: Tensor, ends: Ends, delta: Tensor, x: Tensor, u: Tensor | None) -> Parts:
        with self._given(ends):
            equation = PartialsEquation(driven_by(self.model, u), state, h, 1, increments=True)
            guess, stiffness, bound = at_rest(equation)
            form = StickSlip(equation, stiffness, bound)
            point = form(delta, True)
        end, moved = equation.end(delta, point), soft_threshold(x, bound) - soft_threshold(delta, bound)
        # −J (Δ(x) − Δ): F changes with Δ alone, not with the part of z inside the bound.
        left = point.F - torch.where(form.slides(delta), 0.0, stiffness * (x - delta))
        assert point.J is not None
        L = end.L + (end.p1 * moved).sum(-1)
        return guess, point.F, point.J, (end.p1 + left) - state.p, L, point.rest.D3, bound.clone()

    @contextmanager
    def _given(self, ends: Ends) -> Iterator[None]:
        """The model with a `GivenPotential`; an L_d of the user's own has no potential."""
        potential = self.model.potential
        if isinstance(self.model, OwnLagrangian):
            yield
            return
        self.model.potential = GivenPotential(potential, ends)  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        finally:
            self.model.potential = potential

    def _leap(self, state: State, h: Tensor, here: Field) -> Tensor:
        """A guess of Δ: the leapfrog step with the mass at q = 0 and without the correction network."""
        model = self.model
        if not model.config.baseline:
            return torch.zeros_like(state.q)
        kinetic: Any = model.kinetic
        kinetic = kinetic.base if isinstance(kinetic, FeatureKinetic) else kinetic
        mass = (kinetic.constant if isinstance(kinetic, PositionKinetic) else kinetic).mass()
        root = torch.ones_like(h) if model.damping is None else (-model.damping.rate * h / 2).exp()
        push = state.p - (h / 2)[..., None] * here.slope
        return (push @ torch.linalg.inv_ex(mass)[0]) * (h * root)[..., None]
