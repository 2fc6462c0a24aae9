"""What C is made of: one traced step, with the potential's values at its ends as inputs, for the lowering to cut."""

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
from herglotz.models.feature_kinetic import FeatureKinetic
from herglotz.models.jet import Jet
from herglotz.models.mass import PositionKinetic
from herglotz.models.terms import Potential
from herglotz.stepping import State
from herglotz.stepping.equation import model_equation
from herglotz.stepping.explicit import Leapfrog
from herglotz.stepping.field import Field
from herglotz.stepping.partials_equation import PartialsEquation
from herglotz.stepping.single_step import driven_by
from herglotz.stepping.stick_slip import StickSlip, at_rest

Ends = tuple[Field, Field]  # the potential at q0 and q1
Parts = tuple[Tensor, ...]  # what `StepParts` gives


def step_parts(equations: Equations) -> Graph:
    """`StepParts`, traced."""
    q, p, s, h, *u = example(equations.model, 0.1)
    V, slope = field_like(q)
    more = (V, slope, 0.1 * p, 0.2 * p, V + 1, slope + 1)
    return equations.traced(StepParts(equations.model), (q, p, s, h, *more, *u))


def pushed(model: ContactLagrangian) -> ContactLagrangian:
    """The model with the forces of its inputs as its inputs: G is the unit matrix, u₀ is 0. Changed in place."""
    friction, n = model.friction, model.config.dof
    if model.config.inputs and friction is not None:
        model.config = replace(model.config, inputs=n, input_map=())
        eye = torch.eye(n, dtype=friction.viscous.dtype, device=friction.viscous.device)
        friction.inputs, friction.input_zero = n, None
        del friction.input_map
        friction.register_buffer("input_map", eye)
    return model


class GivenPotential(nn.Module):
    """Stands in for a model's potential where its values at q0 and q1 are inputs: no second derivative is asked for."""

    def __init__(self, potential: Potential, ends: tuple[Field, Field]):
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
    """Everything that a step is made of, for a format that cuts it into pieces itself (`herglotz.export.lower.c`).

    Where the step is explicit, the guess is the solution, and J is not known.
    """

    def __init__(self, model: ContactLagrangian):
        self.model = model

    def __call__(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        """The guess of Δ, F and J at the trial, and p1 − p0, s1 − s0 and c − 1.

        The arguments are q, p (B, n), s, h (B,), V0 (B,) and V′ (B, n) at q0, a trial Δ = q1 − q0 and the exact one
        near by (B, n), V1 and V′ at q1, and the inputs u (B, m) where the model takes some. Where dry friction can hold
        a coordinate, Δ stands for the z of `herglotz.stepping.stick_slip`, and w/K follows.
        """
        (q, p, s, h, V0, slope0, delta, x, V1, slope1), u = arguments[:10], arguments[10:]
        ends = Field(V0, slope0), Field(V1, slope1)
        made_of = self.model.capabilities
        form = self._explicit if made_of.explicit else self._by_terms if made_of.by_terms else self._by_jets
        if made_of.sticking:
            form = self._by_sticking
        guess, F, J, dp, L, E, *bound = form(State(q, p, s), h, ends, delta, x, u[0] if u else None)
        return *(y.clone() for y in (guess, F, J, dp, L)), E.expand(s.shape).clone(), *bound

    def _explicit(self, state: State, h: Tensor, ends: Ends, delta: Tensor, _: Tensor, u: Tensor | None) -> Parts:
        frog = Leapfrog(self.model, field=lambda _: ends[1])
        move = frog(state, h, ends[0], u, True)
        assert move.dp is not None
        maker = model_equation(self.model, fold=False)
        assert maker is not None
        F = maker.at(state, h, u, True, ends[0])(delta, False).F  # for FL⁺, not for the step
        J = F[..., None] * torch.zeros_like(F)[..., None, :]
        return move.delta, F, J, move.dp, move.L, frog.constants(h).c_minus_1

    def _by_terms(self, state: State, h: Tensor, ends: Ends, delta: Tensor, x: Tensor, u: Tensor | None) -> Parts:
        maker = model_equation(self.model, fold=False)
        assert maker is not None
        maker.field = lambda _: ends[1]  # pyright: ignore[reportAttributeAccessIssue]
        form = maker.at(state, h, u, True, ends[0])
        point = form(delta, True)
        v, mv, N, damping, force = form.at(x, point).rest
        if self.model.friction is not None:  # dry friction near rest is steep: it is taken at the exact velocity
            force = self.model.friction.value_and_slope(v, u)[0]
        end = form.end(x, Point(point.F, point.J, (v, mv, N, damping, force)))
        E = form.constants.c_minus_1 if damping is None else damping[1]
        dp = end.dp
        if dp is None:  # F is not quite 0: what x adds to p1 is what it takes from F
            dp = (form.end(delta, point).p1 + point.F) - state.p
        assert point.J is not None
        return form.leap(), point.F, point.J, dp, end.L, E

    def _by_jets(self, state: State, h: Tensor, ends: Ends, delta: Tensor, x: Tensor, u: Tensor | None) -> Parts:
        with self._given(ends):
            form = PartialsEquation(driven_by(self.model, u), state, h, 1, increments=True)
            point = form(delta, True)
        end = form.end(delta, point)
        dp = (end.p1 + point.F) - state.p  # as F is not quite 0
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
        left = point.F - torch.where(form.slides(delta), 0.0, stiffness * (x - delta))  # −J (Δ(x) − Δ)
        assert point.J is not None
        L = end.L + (end.p1 * moved).sum(-1)
        return guess, point.F, point.J, (end.p1 + left) - state.p, L, point.rest.D3, bound.clone()

    @contextmanager
    def _given(self, ends: Ends) -> Iterator[None]:
        """The model with its potential known at q0 and q1."""
        potential = self.model.potential
        if isinstance(self.model, OwnLagrangian):  # it has none
            yield
            return
        self.model.potential = GivenPotential(potential, ends)  # pyright: ignore[reportAttributeAccessIssue]
        try:
            yield
        finally:
            self.model.potential = potential

    def _leap(self, state: State, h: Tensor, here: Field) -> Tensor:
        """The step with the mass at q = 0 and no network of (q̄, v): a guess."""
        model = self.model
        if not model.config.baseline:
            return torch.zeros_like(state.q)
        kinetic: Any = model.kinetic
        kinetic = kinetic.base if isinstance(kinetic, FeatureKinetic) else kinetic
        mass = (kinetic.constant if isinstance(kinetic, PositionKinetic) else kinetic).mass()
        root = torch.ones_like(h) if model.damping is None else (-model.damping.rate * h / 2).exp()
        push = state.p - (h / 2)[..., None] * here.slope
        return (push @ torch.linalg.inv_ex(mass)[0]) * (h * root)[..., None]
