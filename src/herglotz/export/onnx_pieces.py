"""The parts of a rollout that go into an ONNX file, as modules to trace: loops and branches join their graphs."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from herglotz.export.attempt import HISTORY, increments, unsolved
from herglotz.export.equation import example
from herglotz.export.hoist import hoisted
from herglotz.export.newton import Values, remainder
from herglotz.export.one_step import OneStep, Report, SafeStep
from herglotz.export.onnx_leap import Leaps, has_leaps
from herglotz.export.trace import Graph, traced
from herglotz.models import ContactLagrangian

SOLVE = 10  # entries of `Newton`'s carry


class Trouble(nn.Module):
    """Whether a sample that was alive needs more than an attempt gave."""

    def __init__(self, tolerance: float):
        super().__init__()
        self.tolerance = tolerance

    def forward(self, s: Tensor, x: Tensor, after: Tensor, now: Tensor, before: Tensor, size: Tensor) -> Values:
        """The last two increments' sizes, who needs more, (B, 1) or (k, B, 1) of k steps, and whether any does."""
        left, last = increments(after, now, before)
        bad = unsolved(left, last, x, size, self.tolerance)
        return left, last, bad, (bad & (s == s)).any()


class Proceed(nn.Module):
    """What an attempt leaves → the carry of Newton without its count."""

    def __init__(self, one: OneStep):
        super().__init__()
        self.newton = one.newton

    def forward(self, s: Tensor, *x: Tensor) -> tuple[Tensor, ...]:
        """Δ, p1, L, c, the last two increments' sizes, and whether they are too much."""
        return self.newton.proceed(x, s)[1:]


class Iterate(nn.Module):
    """One Newton iteration, and whether another is needed."""

    def __init__(self, one: OneStep):
        super().__init__()
        self.newton = one.newton

    def forward(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, *rest: Tensor) -> tuple[Tensor, ...]:
        """`rest` is the carry, then V, V′ and u."""
        carry = self.newton.iterate((q, p, s, h, *rest[SOLVE:]), rest[:SOLVE], self.newton.equation.constants)
        return self.newton.unfinished(carry[0], carry[1]), *carry


class Outcome(nn.Module):
    """What Newton found → Δ, p1, L, c, the residual and, as a number below 0, the status."""

    def __init__(self, one: OneStep):
        super().__init__()
        self.one = one

    def forward(self, h: Tensor, *found: Tensor) -> tuple[Tensor, ...]:
        """Δ, −J⁻¹F, |F|, done, p1, L, c."""
        *out, status = self.one.outcome(h, found)
        return *out, (-1.0 - status.to(h.dtype))[:, None]


class Conformal(nn.Module):
    """C where h alone decides it."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.damping = model.damping

    def forward(self, h: Tensor) -> Tensor:
        """C = e^{−γh}, or 1."""
        return torch.ones_like(h) if self.damping is None else 1.0 + torch.expm1(self.damping(h, h, h, 1))


class Said(nn.Module):
    """`Report` from rows: the state before a step and after it, c and, where steps iterate, two sizes.

    They are the last two increments' of an attempt, or Newton's residual and −1 − status.
    """

    def __init__(self, report: Report):
        super().__init__()
        self.report = report

    def forward(self, h: Tensor, *x: Tensor) -> tuple[Tensor, ...]:
        """What the file gives, for any number of steps."""
        before, after, c, sizes = x[:3], x[3:6], x[6], x[7:]
        if not sizes:
            return self.report(h, before, after, c, 0.0 * c, None)
        left, last = sizes
        solved = last < 0
        residual = torch.where(solved, left, remainder(left, last))
        return self.report(h, before, after, c, residual, torch.where(solved, -1.0 - last, 0.0).to(torch.uint8))


class Pieces:
    """The traced parts of a rollout; what depends on h alone apart, to be made once for all steps."""

    def __init__(self, one: OneStep, report: Report, model: ContactLagrangian, h: float):
        q, p, s, steps, *u = example(model, h)
        self.one, self.inputs, self.boxed = one, u, report.box is not None
        self.safe = traced(SafeStep(model), (steps,))
        self.conformal = None if model.s_enters_motion else traced(Conformal(model), (steps,))
        self.start = None if one.field is None else traced(FieldAtStart(one.field), (q,))
        rows = [torch.stack([x, -x], 1) for x in (steps, q, p, s, q + 1, p + 1, s + 1, s + 2)]  # two axes in front
        column, h_column = s[:, None], steps[:, None]
        here = (column + 3, 0.3 * q)[: one.kept]
        lost = (0.1 * p, column + 0.1) if one.compensated else ()
        self.lost = len(lost)
        self.leaps = Leaps(model) if not one.iterates and has_leaps(model) else None
        if not one.iterates:
            self.parts = [hoisted(traced(one.explicit, (q, p, column, h_column, *here, *lost, *u)), 3)]
            self.said = traced(Said(report), tuple(rows))
            return
        misses, x = torch.cat([0.1 * p] * HISTORY, -1), 0.1 * q
        start = (q, p, column, h_column, misses, *here, *u)
        land = traced(one.land, (q, column, h_column, x, 2 * p, column + 1, *lost))
        quick = hoisted(traced(one.attempt, start), 3)
        # A matrix of its own needs few evaluations from any guess: the same attempt serves, and Newton behind it.
        patient = hoisted(traced(one.patient, start), 3) if one.attempt.plan.lean else quick
        self.parts = [quick, patient, hoisted(land, 2)]
        found = (x, x + 1, x + 2, x + 3, x + 4)
        self.trouble = traced(Trouble(one.tolerance), (column, *found))
        self.troubles = traced(Trouble(one.tolerance), (column[:, None], *(torch.stack([y, -y], 1) for y in found)))
        solved = (x, 2 * p, column + 1, column + 2, column + 5, column + 6, column > 0)
        self.proceed = traced(Proceed(one), (column, *solved))
        carried = one.newton.proceed(solved, column)
        values = (here[0][:, 0].clone(), *here[1:]) if here else ()
        self.iterate = traced(Iterate(one), (q, p, s, steps, *carried, *values, *u))
        self.outcome = traced(Outcome(one), (steps, x, 0.2 * q, s + 3, s > 0, 2 * p, s + 1, s + 2))
        self.said = traced(Said(report), (*rows, *(torch.stack([s + i, s - i], 1) for i in (3, 4))))


class FieldAtStart(nn.Module):
    """The potential at a position, V as (B, 1)."""

    def __init__(self, field: Graph):
        super().__init__()
        self.field = field

    def forward(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """V and V′."""
        V, slope = self.field(q)
        return V[:, None], slope
