"""The step equation of a model and its first derivatives as plain functions of tensors, for tracing."""

from __future__ import annotations

import copy
import inspect
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from herglotz.export.trace import Graph, example_batch, traced
from herglotz.mechanics import Partials, momentum_jacobian, momentum_plus, momentum_residual
from herglotz.models import ContactLagrangian

LEAN = 6  # outputs of `StepEquation` that every Newton iteration needs; the others are slopes


class StepEquation(nn.Module):
    """F(Δ) = D1 L_d + c p0 at a trial increment Δ = q1 − q0, with a Newton step; nothing in it differentiates.

    Parameters
    ----------
    model
        The discrete Lagrangian; not copied.
    """

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.model = model

    def forward(self, q0: Tensor, p0: Tensor, s0: Tensor, h: Tensor, delta: Tensor, *u: Tensor) -> tuple[Tensor, ...]:
        """−J⁻¹F (B, n), |J⁻¹cp0| and |F| (B,), p1 (B, n), L_d, c (B,), then J, ∂p1/∂q1 (B, n, n), ∂c/∂q1 (B, n)."""
        P = _partials(self.model, q0, delta, s0, h, u, 2)
        F, J = momentum_residual(P, p0), momentum_jacobian(P, p0)
        move, size = eliminate(J, torch.stack([F, P.c[..., None] * p0], -1)).unbind(-1)
        slopes = (J, P.D22 if P.force is None else P.D22 + P.force.plus_2, P.D23)
        return tuple(dense(x) for x in (-move, length(size), length(F), momentum_plus(P), P.L, P.c, *slopes))


class FirstOrder(nn.Module):
    """The same equation with first derivatives only."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.model = model

    def forward(self, q0: Tensor, p0: Tensor, s0: Tensor, h: Tensor, delta: Tensor, *u: Tensor) -> tuple[Tensor, ...]:
        """F (B, n), p1 (B, n), L_d (B,), c (B,), D2 L_d (B, n)."""
        P = _partials(self.model, q0, delta, s0, h, u, 1)
        return tuple(dense(x) for x in (momentum_residual(P, p0), momentum_plus(P), P.L, P.c, P.D2))


@dataclass(frozen=True)
class Equations:
    """A model's equations, each traced once however many programs hold it."""

    model: ContactLagrangian

    @classmethod
    def of(cls, model: ContactLagrangian | Equations) -> Equations:
        """Those of a copy of the model, which no export can change or train."""
        return model if isinstance(model, Equations) else cls(copy.deepcopy(model).eval().requires_grad_(False))

    @cached_property
    def newton(self) -> Graph:
        """`StepEquation` without slopes."""
        return self.slopes.first(LEAN)

    @cached_property
    def slopes(self) -> Graph:
        """`StepEquation`."""
        return self._traced(StepEquation(self.model))

    @cached_property
    def first_order(self) -> Graph:
        """`FirstOrder`."""
        return self._traced(FirstOrder(self.model))

    def _traced(self, module: nn.Module) -> Graph:
        q, p, s, h, *u = example(self.model, 0.1)
        return traced(module, (q, p, s, h, 0.1 * p, *u))


def input_count(model: ContactLagrangian) -> int:
    """The number m of inputs u (a motor's torque) that a step of this model takes."""
    return int(getattr(model.config, "inputs", 0) or 0)


def _partials(
    model: ContactLagrangian, q0: Tensor, delta: Tensor, s0: Tensor, h: Tensor, u: tuple[Tensor, ...], order: int
) -> Partials:
    """The closed-form partials, at the input u where the model takes one."""
    at: Any = model.at(*u) if u else model
    return at.partials_increment(q0, delta, s0, h, order=order)


def eliminate(A: Tensor, b: Tensor) -> Tensor:
    """A⁻¹ b by elimination with row exchanges, written out: ONNX has no solve, AOTInductor calls it slowly.

    Parameters
    ----------
    A, b
        (..., n, n) and (..., n, k); n is small.

    Returns
    -------
    Tensor
        (..., n, k); inf or nan where A is singular.
    """
    n = b.shape[-2]
    if n == 1:
        return b / A
    rows = [torch.cat([A[..., i, :], b[..., i, :]], -1) for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            swap = (rows[i][..., k].abs() > rows[k][..., k].abs())[..., None]
            rows[k], rows[i] = torch.where(swap, rows[i], rows[k]), torch.where(swap, rows[k], rows[i])
        for i in range(k + 1, n):
            rows[i] = rows[i] - (rows[i][..., k] / rows[k][..., k])[..., None] * rows[k]
    x: list[Tensor] = []
    for i in reversed(range(n)):
        value = rows[i][..., n:]
        for j, known in zip(range(n - 1, i, -1), x, strict=True):
            value = value - rows[i][..., j : j + 1] * known
        x.append(value / rows[i][..., i : i + 1])
    return torch.stack(x[::-1], -2)


def length(x: Tensor) -> Tensor:
    """The largest |x_i|, shape (...)."""
    return x.abs().amax(-1)


def dense(x: Tensor) -> Tensor:
    """A copy in standard layout: `.contiguous()` does nothing at B = 1, and loops compare strides."""
    return x.clone(memory_format=torch.contiguous_format)


def example(model: ContactLagrangian, h: float) -> tuple[Tensor, ...]:
    """q, p (B, n), s, h (B,) and, where the model takes some, u (B, m) to trace with: every tensor its own."""
    parameter = next(model.parameters())
    batch = example_batch({size for x in model.parameters() for size in x.shape})
    make = torch.Generator().manual_seed(0)
    options: dict[str, Any] = {"dtype": parameter.dtype, "device": parameter.device}
    q, p = (0.1 * torch.randn(batch, model.config.dof, generator=make).to(**options) for _ in range(2))
    s, steps = torch.zeros(batch, **options), torch.full((batch,), float(h), **options)
    m = input_count(model)
    return q, p, s, steps, *((torch.zeros(batch, m, **options),) if m else ())


def batched(module: nn.Module, shapes: tuple[Any, ...]) -> tuple[Any, ...]:
    """One entry an argument, as torch.export wants them: what arrives through *u is a tuple of its own."""
    kinds = [parameter.kind for parameter in inspect.signature(module.forward).parameters.values()]
    fixed = len(kinds) - (kinds[-1] == inspect.Parameter.VAR_POSITIONAL)
    return (*shapes[:fixed], shapes[fixed:]) if len(shapes) > fixed else shapes
