"""The step equation of a model as traced functions of tensors, and its derivatives by the implicit-function theorem.

The arguments of a step equation are q0, p0 (B, n), s0, h (B,), then Δ = q1 − q0 (B, n), then V and V′ at q0 where the
model has known terms, then u (B, m) where the model takes inputs. p1 and s1 come without the share of the potential at
q1, which the caller adds.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from herglotz.codegen.trace import PRIMES, Graph, traced
from herglotz.mechanics.newton import Point
from herglotz.models import ContactLagrangian
from herglotz.models.numbers import WithNumbers
from herglotz.stepping import State
from herglotz.stepping.equation import End, PartialsEquation, StepOfModel, model_equation
from herglotz.stepping.explicit import Field, FieldOf
from herglotz.stepping.linearise import eliminate, step_functions, step_jacobian, step_pull
from herglotz.stepping.newton import StickSlip
from herglotz.stepping.single_step import driven_by
from herglotz.stepping.velocity import legendre


def equation_of(
    model: ContactLagrangian, state: State, h: Tensor, more: tuple[Tensor, ...]
) -> StepOfModel | PartialsEquation:
    """The step equation at (q0, p0, s0, h): by terms where `model_equation` knows the model, else by jets.

    `more` are V and V′ at q0 and u, as far as the model has them.
    """
    maker = model_equation(model, fold=False)
    if maker is None:
        return PartialsEquation(driven_by(model, more[0] if more else None), state, h, 1, increments=True)
    return maker.at(state, h, more[2] if len(more) > 2 else None, True, Field(*more[:2]))


def gained(equation: StepOfModel | PartialsEquation, x: Tensor, point: Point) -> End:
    """p1, L and c at Δ = x, without the share of the potential at q1.

    `point` may be the equation at a Δ very near to x; the kinetic term, which changes fastest, is evaluated at x.
    """
    if isinstance(equation, PartialsEquation):
        return equation.end(x, point)
    return equation.end_without_field(equation.at(x, point))


def step_equation(model: ContactLagrangian, bounds: int, *x: Tensor) -> tuple[Tensor, ...]:
    """A Newton step from a trial Δ and the end of the step there: −J⁻¹F, |J⁻¹cp0|, |F|, p1, L, c, J.

    Where the arguments end with K and w/K (`bounds` is 2), Δ is the z of `herglotz.stepping.newton.StickSlip`.
    """
    (q, p, s, h, delta), more, sticking = x[:5], x[5 : len(x) - bounds], x[len(x) - bounds :]
    form = equation = equation_of(model, State(q, p, s), h, more)
    if sticking:
        assert isinstance(equation, PartialsEquation)
        form = StickSlip(equation, *sticking)
    point = form(delta, True)
    assert point.J is not None
    move, size = eliminate(point.J, torch.stack([point.F, equation.push(point)], -1)).unbind(-1)
    end = gained(equation, delta, point)
    return tuple(dense(y) for y in (-move, length(size), length(point.F), *end[:3], point.J))


def first_order(model: ContactLagrangian, *x: Tensor) -> tuple[Tensor, ...]:
    """F, p1 (B, n), L, c (B,) of the step equation, from first derivatives of L_d alone."""
    (q, p, s, h, delta), more = x[:5], x[5:]
    equation = equation_of(model, State(q, p, s), h, more)
    point = equation(delta, False)
    return tuple(dense(y) for y in (point.F, *gained(equation, delta, point)[:3]))


@dataclass(frozen=True)
class Equations:
    """A model's equations, each traced once for all programs.

    `numbers` are the model's numbers that are set at run time, with their values: the last argument θ (K,) of each
    equation.
    """

    model: ContactLagrangian
    numbers: Mapping[str, float] | None = None

    @classmethod
    def of(cls, model: ContactLagrangian, numbers: Mapping[str, float] | None = None) -> Equations:
        """The equations of a copy of the model, which no export can change or train."""
        return cls(copy.deepcopy(model).eval().requires_grad_(False), numbers)

    @property
    def theta(self) -> tuple[Tensor, ...]:
        """(θ,) with the values of `numbers`, (K,); empty without numbers."""
        like = next(self.model.parameters())
        return (like.new_tensor([*self.numbers.values()]),) if self.numbers else ()

    def of_numbers(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function of the model with the last argument θ; unchanged without numbers."""
        return WithNumbers(self.model, function, [*self.numbers]).at if self.numbers else function

    def traced(self, function: Callable[..., Any], arguments: tuple[Tensor, ...]) -> Graph:
        """The graph of `of_numbers(function)` at these arguments and θ."""
        return traced(self.of_numbers(function), (*arguments, *self.theta))

    @cached_property
    def potential(self) -> Graph:
        """V (B,) and V′ (B, n) at a position."""
        q = example(self.model, 0.1)[0]
        return self.traced(lambda q: tuple(map(dense, FieldOf(self.model.potential)(q))), (q,))

    @property
    def field(self) -> Graph | None:
        """The potential, where a step hands its value at q1 on to the next step; else None."""
        return self.potential if self.model.capabilities.by_terms else None

    @cached_property
    def slopes(self) -> Graph:
        """`step_equation` as a graph."""
        return self._traced(partial(step_equation, self.model, 0))

    @cached_property
    def first_order(self) -> Graph:
        """`first_order` as a graph."""
        return self._traced(partial(first_order, self.model))

    @cached_property
    def jacobian(self) -> Graph:
        """The derivative of a solved step at Δ, d(q, p, s)′ / d(q, p, s, h, u, θ), (B, 2n+1, 2n+2+m+K)."""
        q, p, s, h, *u = example(self.model, 0.1)
        functions = self.of_numbers(step_functions(self.model))

        def slopes(q: Tensor, p: Tensor, s: Tensor, h: Tensor, delta: Tensor, *more: Tensor) -> Tensor:
            u, theta = self._u_and_theta(more)
            return dense(step_jacobian(functions, State(q, p, s), h, delta, u, theta=theta))

        return traced(slopes, (q, p, s, h, 0.1 * p, *u, *self.theta))

    @cached_property
    def pull(self) -> Graph:
        """`step_pull` of a solved step at Δ: from derivatives (B, 2n+1) by the state after the step, those before it.

        The result is by (q, p, s, h, u), (B, 2n+2+m), and with `numbers` by θ, (B, K).
        """
        q, p, s, h, *u = example(self.model, 0.1)
        functions = self.of_numbers(step_functions(self.model))

        def pull(
            q: Tensor, p: Tensor, s: Tensor, h: Tensor, delta: Tensor, after: Tensor, *more: Tensor
        ) -> tuple[Tensor, ...]:
            u, theta = self._u_and_theta(more)
            rows, by_theta = step_pull(functions, State(q, p, s), h, delta, u, after, theta)
            return (dense(rows),) if by_theta is None else (dense(rows), dense(by_theta))

        after = torch.cat([0.3 * q, 0.2 * p, s[:, None] + 1], -1)
        return traced(pull, (q, p, s, h, 0.1 * p, after, *u, *self.theta))

    @cached_property
    def momentum(self) -> Graph:
        """`herglotz.stepping.velocity.legendre` at (q, v, s, h): L_v, L_vv and the terms of set-valued friction."""
        q, v, s, h, *_ = example(self.model, 0.1)

        def transform(*x: Tensor) -> tuple[Tensor, ...]:
            return tuple(dense(y) for y in legendre(self.model, *x) if y is not None)

        return self.traced(transform, (q, v, s, h))

    def _u_and_theta(self, more: tuple[Tensor, ...]) -> tuple[Tensor | None, Tensor | None]:
        """The inputs and θ among the last arguments of a function."""
        return more[0] if self.model.inputs else None, more[-1] if self.numbers else None

    def _traced(self, function: Callable[..., Any]) -> Graph:
        q, p, s, h, *u = example(self.model, 0.1)
        here = field_like(q) if self.model.capabilities.by_terms else ()
        return traced(function, (q, p, s, h, 0.1 * p, *here, *u))


def field_like(q: Tensor) -> tuple[Tensor, Tensor]:
    """Example values of V (B,) and V′ (B, n) at q, to trace with."""
    return 0.3 * q.sum(-1), 0.3 * q


def inverse(matrix: Tensor) -> Tensor:
    """The inverse of matrices (..., n, n)."""
    return eliminate(matrix, torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device).expand_as(matrix))


def length(x: Tensor) -> Tensor:
    """The largest |x_i|, shape (...)."""
    return x.abs().amax(-1)


def dense(x: Tensor) -> Tensor:
    """A copy in standard layout: `.contiguous()` keeps the strides at B = 1, and loops compare strides."""
    return x.clone(memory_format=torch.contiguous_format)


def example(model: ContactLagrangian, h: float) -> tuple[Tensor, ...]:
    """q, p (B, n), s, h (B,) and, where the model takes inputs, u (B, m) to trace with; no two share memory."""
    parameter = next(model.parameters())
    make = torch.Generator().manual_seed(0)
    options: dict[str, Any] = {"dtype": parameter.dtype, "device": parameter.device}
    q, p = (0.1 * torch.randn(PRIMES[0], model.config.dof, generator=make).to(**options) for _ in range(2))
    s, steps = torch.zeros(PRIMES[0], **options), torch.full((PRIMES[0],), float(h), **options)
    m = model.inputs
    return q, p, s, steps, *((torch.zeros(PRIMES[0], m, **options),) if m else ())
