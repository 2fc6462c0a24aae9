"""One step of a rollout as a module: an attempt with Newton's loop behind it, what it hands on, and its report."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from herglotz.export.attempt import HISTORY, Attempt, Explicit, Land, Plan, increments, plans, unsolved
from herglotz.export.box import Box, outside
from herglotz.export.equation import Equations, dense, example, length
from herglotz.export.metadata import TOLERANCE
from herglotz.export.newton import (
    BAD_INPUT,
    CONVERGED,
    DIVERGED,
    SINGULAR,
    Newton,
    Values,
    remainder,
    status_of,
)
from herglotz.export.trace import Graph, traced
from herglotz.models import ContactLagrangian
from herglotz.models.terms import LinearDamping


class Report(nn.Module):
    """What steps say of themselves, for any number of them at once: status, and NaN where they failed."""

    def __init__(self, box: Box | None):
        super().__init__()
        self.box = box

    @property
    def bounds(self) -> Values:
        """Of the box."""
        return () if self.box is None else self.box.bounds

    def forward(
        self,
        h: Tensor,
        before: Values,
        after: Values,
        c: Tensor,
        residual: Tensor,
        status: Tensor | None,
        bounds: Values | None = None,
    ) -> Values:
        """q1, p1, s1, c, residual, status[, outside] from two states and what the solver said, if it did."""
        q1, p1, s1 = after
        sound = torch.isfinite(residual + s1) & torch.isfinite(q1 + p1).all(-1)
        found = torch.where(sound, CONVERGED, DIVERGED)
        if status is not None:
            found = torch.where(status != CONVERGED, status.to(found.dtype), found)
        found = torch.where(c == 0, SINGULAR, found)
        found = torch.where((h > 0) & torch.isfinite(h), found, BAD_INPUT).to(torch.uint8)
        nan = torch.where(found == CONVERGED, 0.0, torch.nan).to(q1.dtype)
        new = (q1 + nan[..., None], p1 + nan[..., None], s1 + nan)
        return (
            *new,
            c + nan,
            residual.clone(),
            found,
            *outside(self.bounds if bounds is None else bounds, h, before, new),
        )


class OneStep(nn.Module):
    """One step of a rollout, and what it hands to the next.

    The carry is q, p, s, then V and V′ at q where the model has them, the last misses (see `Attempt`) where steps
    iterate, and in float32 what rounding took from q and s (Kahan's sum, without which a digit is lost every ten
    steps). Numbers a sample are (B, 1).

    Parameters
    ----------
    equations
        Of the model.
    iterations
        Bound on the Newton iterations.
    plan
        Of the attempt; default the cheapest.
    whole
        Trace what `forward` calls; False where only the parts are wanted.
    """

    def __init__(self, equations: Equations, iterations: int, plan: Plan | None = None, whole: bool = True):
        super().__init__()
        model = equations.model
        dtype = next(model.parameters()).dtype
        self.compensated = dtype == torch.float32
        self.iterates = not model.capabilities.explicit
        self.field = equations.field
        self.kept = 2 if self.field is not None else 0
        if self.iterates:
            plan = plans(model)[0] if plan is None else plan
            self.newton = Newton(equations.newton, iterations, max(model.config.speed))
            self.attempt, self.patient = Attempt(model, plan), Attempt(model, plan.patient)
            self.tolerance = TOLERANCE * torch.finfo(dtype).eps
            self.land = Land(model, self.field is not None)
        else:
            self.explicit = Explicit(model)
        self.graphs = nn.ModuleList(self._traced(model) if whole else [])

    def _traced(self, model: ContactLagrangian) -> list[Graph]:
        """What the step is made of, traced."""
        q, p, s, h, *u = example(model, 0.1)
        s, h = s[:, None], h[:, None]
        here = (s + 3, 0.3 * q)[: self.kept]
        lost = (0.1 * p, s + 0.1) if self.compensated else ()
        if not self.iterates:
            return [traced(Explicit(model, fused=True), (q, p, s, h, *here, *lost, *u))]
        misses = torch.cat([0.1 * p] * HISTORY, -1)
        attempt = traced(Attempt(model, self.attempt.plan, fused=True), (q, p, s, h, misses, *here, *u))
        land = Land(model, self.field is not None, fused=True)
        return [attempt, traced(land, (q, s, h, 0.1 * p, p + 1, s + 1, *lost)), self.newton.equation]

    def _graph(self, i: int) -> Graph:
        return self.graphs[i]  # pyright: ignore[reportReturnType]

    @property
    def operands(self) -> list[Values]:
        """The constants of each graph."""
        return [self._graph(i).constants for i in range(len(self.graphs))]

    def start(self, q: Tensor, p: Tensor, s: Tensor) -> Values:
        """The carry before the first step; s is (B,)."""
        here = ()
        if self.field is not None:
            V, slope = self.field(q)
            here = (V[:, None].clone(), slope)
        misses = (torch.zeros_like(q).repeat(1, HISTORY),) if self.iterates else ()
        lost = (torch.zeros_like(q), torch.zeros_like(s)[:, None]) if self.compensated else ()
        return dense(q), dense(p), s[:, None].clone(), *here, *misses, *lost

    def forward(
        self, carry: Values, h: Tensor, u: Values, constants: Sequence[Values]
    ) -> tuple[Values, Values, Tensor | None]:
        """The next carry; what the step gives: q1, p1, s1, c, residual; and, where steps iterate, the status."""
        q, p, s, *rest = carry
        here, rest = tuple(rest[: self.kept]), rest[self.kept :]
        if not self.iterates:
            *new, c = self._graph(0).call(q, p, s, h[:, None], *here, *rest, *u, *constants[0])
            return tuple(new), (*(x.clone() for x in new[:2]), new[2][:, 0].clone(), c[:, 0].clone(), 0.0 * h), None
        misses, *lost = rest
        x, p1, L, c, *iterates, size = self._graph(0).call(q, p, s, h[:, None], misses, *here, *u, *constants[0])
        left, last = increments(*iterates)
        bad = unsolved(left, last, x, size, self.tolerance)
        values = (here[0][:, 0], *here[1:]) if here else ()
        found = self.newton.forward(
            (q, p, s[:, 0], h, *values, *u), self.newton.proceed((x, p1, L, c, left, last, bad), s), constants[2]
        )
        *other, status = self.outcome(h, found)
        # Inductor may put something else where the loop would have left its results, if it makes no turn: a result is
        # taken from the loop only where there was one.
        over = ~bad | (s != s)
        leap, pairs = x - iterates[0], zip((x, p1, L, c, remainder(left, last)), other, strict=True)
        x, p1, L, c, residual = (torch.where(over, a, b) for a, b in pairs)
        status = torch.where(over[:, 0], CONVERGED, status).to(torch.uint8)
        new = self._graph(1).call(q, s, h[:, None], x, p1, L, *lost, *constants[1])
        q1, p1, s1, *there = new
        there, lost = there[: self.kept], there[self.kept :]
        n = q.shape[-1]
        misses = torch.cat([x - leap, misses[:, : (HISTORY - 1) * n]], -1)
        out = (q1.clone(), p1.clone(), s1[:, 0].clone(), c[:, 0].clone(), residual[:, 0].clone())
        return (q1, p1, s1, *there, misses, *lost), out, status

    def outcome(self, h: Tensor, found: Values) -> Values:
        """Δ, p1, L, c, residual and status of Newton's end, NaN where it failed; h and status are (B,)."""
        x, step, merit, done, p1, L, c = found
        residual = length(step)
        status = status_of(h, merit, residual, done, L, c)
        nan = torch.where(status == CONVERGED, 0.0, torch.nan).to(x.dtype)[:, None]
        return x + nan, p1 + nan, L[:, None] + nan, c[:, None].clone(), residual[:, None], status


class SafeStep(nn.Module):
    """h, NaN where it is no step or where c = e^{−γh} rounds to 0: no sample can pass it without a status."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        damping = model.damping
        constant = isinstance(damping, LinearDamping)
        self.register_buffer("gamma", damping.rate.detach().clone() if constant else None)

    @property
    def rate(self) -> Values:
        """(γ,) where c depends on h alone."""
        gamma = self.gamma
        return (gamma,) if isinstance(gamma, Tensor) else ()

    def forward(self, h: Tensor) -> Tensor:
        """The same h elsewhere."""
        return safe_step(h, self.rate)


def safe_step(h: Tensor, rate: Values) -> Tensor:
    """See `SafeStep`; `rate` is (γ,) or empty."""
    good = (h > 0) & torch.isfinite(h)
    if rate:
        good = good & (1.0 + torch.expm1(-rate[0] * h) != 0)
    return torch.where(good, h, torch.nan)
