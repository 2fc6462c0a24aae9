"""Steps, rollouts and starts of the flow Φ̃ as modules of plain tensor operations: what exported files contain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch._higher_order_ops.scan import scan_op

from herglotz.errors import InputError
from herglotz.export.attempt import Plan
from herglotz.export.box import Box
from herglotz.export.equation import Equations, eliminate, inverse, length
from herglotz.export.newton import ITERATIONS, Newton, Values, status_of
from herglotz.export.one_step import OneStep, Report, SafeStep, safe_step
from herglotz.models import ContactLagrangian
from herglotz.stepping.explicit import Leapfrog


class StepModule(nn.Module):
    """(q, p, s, h[, u]) → (q1, p1, s1, c, residual, status[, outside]), differentiable in the state.

    The solve is outside autograd; its derivative is that of the implicit-function theorem, dΔ = −J⁻¹ dF, with J from
    the last accepted iteration. A step in closed form is differentiated as it stands.

    Parameters
    ----------
    model
        The discrete Lagrangian, copied; or its equations.
    iterations
        Bound on the Newton iterations, at least 2.
    box, h_range
        Add the output `outside`, uint8: 1 where the step starts or ends outside the box, and 2 where h is outside.
    """

    def __init__(
        self,
        model: ContactLagrangian | Equations,
        iterations: int = ITERATIONS,
        box: Mapping[str, Sequence[float]] | None = None,
        h_range: Sequence[float] | None = None,
    ):
        super().__init__()
        if iterations < 2:
            raise InputError(f"newton_iterations must be at least 2, got {iterations}; {ITERATIONS} suits most models")
        equations = Equations.of(model)
        self.model, self.field = equations.model, equations.field
        if not self.model.capabilities.explicit:
            top = max(self.model.config.speed)
            self.newton, self.first_order = Newton(equations.slopes, iterations, top), equations.first_order
        self.report = Report(Box.of(box, equations.model, h_range))

    def forward(
        self,
        q: Tensor,  # (B, n)
        p: Tensor,  # (B, n)
        s: Tensor,  # (B,)
        h: Tensor,  # (B,)
        *u: Tensor,  # (B, m) where the model takes inputs
    ) -> Values:
        """One step: guess → solve → attach the derivative → momentum and action.

        Returns
        -------
        tuple of Tensor
            q1 (B, n), p1 (B, n), s1 (B,), c (B,), residual |J⁻¹F| (B,) in units of q, status (B,) uint8 and, with a
            box, outside (B,) uint8. NaN in the samples whose status is not `Status.CONVERGED`.
        """
        if self.model.capabilities.explicit:
            move = Leapfrog(self.model, inverse)(q, p, s, h, u=u[0] if u else None)
            return self.report(h, (q, p, s), (move.q1, move.p1, s + move.L), move.c.clone(), 0.0 * s, None)
        here = () if self.field is None else self.field(q)
        problem = tuple(x.detach() for x in (q, p, s, h, *here, *u))
        carry = self.newton.start(problem[0], problem[2], torch.zeros_like(problem[0]), with_J=True)
        delta, step, merit, done, _, L, c, J = self.newton(problem, carry, self.newton.equation.constants)
        residual = length(step)
        status = status_of(h, merit, residual, done, L, c)
        F = self.first_order(q, p, s, h, delta, *here, *u)[0]
        delta = delta - eliminate(J, (F - F.detach())[..., None])[..., 0]  # the same value
        _, p1, L, c = self.first_order(q, p, s, h, delta, *here, *u)
        q1 = q + delta
        if self.field is not None:
            V, slope = self.field(q1)
            L, p1 = L - h / 2 * V, p1 - (h / 2)[..., None] * slope
        return self.report(h, (q, p, s), (q1, p1, s + L), c, residual, status)


class RolloutModule(nn.Module):
    """(q, p, s, h[, u]) → K steps, h of shape (K, B): all loops are inside the graph.

    Parameters
    ----------
    model
        The discrete Lagrangian, copied; or its equations.
    iterations
        Bound on the Newton iterations of a step.
    box, h_range
        As in `StepModule`.
    plan
        Of the attempt that Newton's loop stands behind.
    """

    def __init__(
        self,
        model: ContactLagrangian | Equations,
        iterations: int = ITERATIONS,
        box: Mapping[str, Sequence[float]] | None = None,
        plan: Plan | None = None,
        h_range: Sequence[float] | None = None,
    ):
        super().__init__()
        equations = Equations.of(model)
        self.one = OneStep(equations, iterations, plan)
        self.safe = SafeStep(equations.model)
        self.report = Report(Box.of(box, equations.model, h_range))

    def forward(
        self,
        q: Tensor,  # (B, n)
        p: Tensor,  # (B, n)
        s: Tensor,  # (B,)
        h: Tensor,  # (K, B)
        *u: Tensor,  # (K, B, m)
    ) -> Values:
        """K steps from one state.

        Returns
        -------
        tuple of Tensor
            q, p (K, B, n), s, c, residual (K, B), status (K, B) uint8 and, with a box, outside (K, B) uint8: what step
            k = 1 … K gives. NaN from a failed step on.
        """
        carry = self.one.start(q, p, s)
        operands = self.one.operands
        counts = [len(constants) for constants in operands]
        edges = len(self.report.bounds)
        ends = len(carry), len(carry) + 1 + len(u)

        def step(*x: Any) -> list[Tensor]:
            carry, (h, *u), (size, *fixed) = x[: ends[0]], x[ends[0] : ends[1]], x[ends[1] :]
            # The sum keeps the batch size a symbol of this graph, which inductor needs to allocate the outputs.
            h = h + torch.zeros(size, dtype=h.dtype, device=h.device)
            constants = [tuple(fixed[sum(counts[:i]) : sum(counts[: i + 1])]) for i in range(len(counts))]
            before = (*carry[:2], carry[2][:, 0])
            gamma, bounds = tuple(fixed[sum(counts) : len(fixed) - edges]), tuple(fixed[len(fixed) - edges :])
            carry, out, status = self.one.forward(carry, safe_step(h, gamma), tuple(u), constants)
            *after, c, residual = out
            return [*carry, *self.report.forward(h, before, tuple(after), c, residual, status, bounds)]

        fixed = (*(x for constants in operands for x in constants), *self.safe.rate, *self.report.bounds)
        return tuple(scan_op(step, list(carry), [h, *u], (s.shape[0], *fixed))[len(carry) :])


class InitModule(nn.Module):
    """(q0, q1, s0, h[, u]) → (p1, s1) = (D2 L_d + F⁺, s0 + L_d): the state from two positions, differentiable."""

    def __init__(self, model: ContactLagrangian | Equations):
        super().__init__()
        equations = Equations.of(model)
        self.first_order, self.field = equations.first_order, equations.field

    def forward(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, *u: Tensor) -> tuple[Tensor, Tensor]:
        """p1 (B, n) and s1 (B,)."""
        here = () if self.field is None else self.field(q0)
        _, p1, L, _ = self.first_order(q0, torch.zeros_like(q0), s0, h, q1 - q0, *here, *u)
        if self.field is not None:
            V, slope = self.field(q1)
            L, p1 = L - h / 2 * V, p1 - (h / 2)[..., None] * slope
        return p1, s0 + L
