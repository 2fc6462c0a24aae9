"""A whole step with a fixed number of operations, and whether it is good enough: what a rollout does most of the time.

Shapes: q, p, Δ and V′ are (B, n); h, s, V and every other number a sample are (B, 1).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from herglotz.export.equation import Terms, inverse
from herglotz.export.lean import FlatField, LeanEquation, LeanField, is_lean
from herglotz.export.metadata import TOLERANCE
from herglotz.models import ContactLagrangian
from herglotz.stepping import Stepper
from herglotz.stepping.explicit import Leapfrog
from herglotz.stepping.field import Field

WEIGHTS = (6.0, -15.0, 20.0, -15.0, 6.0, -1.0)  # of the last misses: the polynomial through them, continued
HISTORY = len(WEIGHTS)
ENOUGH = 0.998  # of the steps: a plan that solves this many is not bettered by a dearer one


class Plan(NamedTuple):
    """How an attempt solves the step equation."""

    lean: bool  # with the matrix of the kinetic term alone (`LeanEquation`); else with J at the guess
    evaluations: int  # at least 2; or 0: no attempt, its guess is where Newton's loop starts

    @property
    def patient(self) -> Plan:
        """For a step without a good guess."""
        return self._replace(evaluations=self.evaluations + 3) if self.evaluations else self


class Attempt(nn.Module):
    """One matrix, a few evaluations, from a guess that the steps before give.

    A miss is what Δ had beyond the leap, the step without what couples q1: it is small and smooth, and the polynomial
    through the last ones tells the next. The last increment is taken; with the kinetic matrix, what it leaves is judged
    by the rate at which increments shrink (Hairer and Wanner, Solving Ordinary Differential Equations II, IV.8).

    Parameters
    ----------
    model
        The discrete Lagrangian; not copied.
    plan
        The matrix and the number of evaluations.
    fused
        For a compiler, which joins operations, not for an interpreter, which counts them (`herglotz.export.lean`).
    """

    def __init__(self, model: ContactLagrangian, plan: Plan, fused: bool = False):
        super().__init__()
        self.model, self.plan, self.fused = model, plan, fused

    def forward(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, misses: Tensor, *more: Tensor) -> tuple[Tensor, ...]:
        """Δ, p1, L and c (without what V at q1 adds); the last three iterates (a miss each), and a size of Δ (B, n).

        `misses` (B, 6n), the latest first; `more` holds V and V′ at q where the model has them, then u.
        """
        miss = misses @ continuation(q)
        if not self.plan.evaluations:  # increments that are no numbers: unsolved, whatever the tolerance
            after = miss + torch.inf
            return miss, torch.zeros_like(p), torch.zeros_like(s), torch.ones_like(s), miss, after, after, miss
        if self.plan.lean:
            return self._lean(q, p, s, h, miss, more)
        terms = Terms(self.model, q, p, s[:, 0], h[:, 0], (more[0][:, 0], *more[1:]) if len(more) > 1 else more)
        leap = terms.leap(q)
        x = leap + miss
        point = terms(x, True)
        assert point.J is not None
        over = Inverse(point.J)
        size = over(terms.equation.push(point))
        delta = -over(point.F)
        for _ in range(self.plan.evaluations - 1):
            x, miss = x + delta, miss + delta
            point = terms(x, False)
            delta = -over(point.F)
        # J shrinks increments faster than it does what networks at the last evaluated point miss: no rate, but the last
        # increment itself is to be small. Jets know what is gained at evaluated points only.
        after = before = miss + delta
        x = x if terms.whole else x + delta
        p1, L, c, _ = terms.gained(x, point)
        if self.model.s_enters_motion:  # where c depends on h alone, `SafeStep` sees to it
            size = torch.where((c > 0)[:, None], size, torch.nan)
        return x, p1, L[:, None], c[:, None], after, miss, before, size

    def _lean(
        self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, e: Tensor, more: tuple[Tensor, ...]
    ) -> tuple[Tensor, ...]:
        """With two evaluations e0 = e(leap + miss), e1 = e(leap + e0), Δ = leap + e1."""
        V, slope, *u = more
        terms = LeanEquation(self.model, q, p, s, h, V, slope, u[0] if u else None, self.fused)
        iterates = [e]
        for _ in range(self.plan.evaluations):
            iterates.append(terms(terms.leap + iterates[-1]))
        x = terms.leap + iterates[-1]
        return x, *terms.gained(x), *iterates[:-4:-1], terms.leap


def increments(after: Tensor, now: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
    """The sizes of the last two increments, (..., 1)."""
    return tuple((a - b).abs().sum(-1, keepdim=True) for a, b in ((after, now), (now, before)))  # pyright: ignore


def unsolved(left: Tensor, last: Tensor, x: Tensor, size: Tensor, tolerance: float) -> Tensor:
    """Whether an increment leaves more than the tolerance of Δ, by the rate at which increments shrink, (..., 1)."""
    sizes = torch.cat([x, size], -1).abs().sum(-1, keepdim=True)
    return ~(left * left <= (tolerance * sizes) * last)


class Land(nn.Module):
    """q1, p1, s1, the potential there where the model has one, and what rounding took.

    Parameters
    ----------
    model
        The discrete Lagrangian; not copied.
    field
        Whether V at q1 is still to be added.
    fused
        As in `Attempt`.
    """

    def __init__(self, model: ContactLagrangian, field: bool, fused: bool = False):
        super().__init__()
        self.field = LeanField(model.potential, fused) if field else None

    def forward(
        self, q: Tensor, s: Tensor, h: Tensor, delta: Tensor, p1: Tensor, L: Tensor, *lost: Tensor
    ) -> tuple[Tensor, ...]:
        """From the step's start, what it gains, and what rounding took before."""
        more = delta + lost[0] if lost else delta
        q1 = q + more
        there: tuple[Tensor, ...] = ()
        if self.field is not None:
            half = h / 2
            V, slope = there = self.field(q1)
            L, p1 = L - half * V, p1 - half * slope
        gain = L + lost[1] if lost else L
        s1 = s + gain
        lost = (more - (q1 - q), gain - (s1 - s)) if lost else ()
        return q1, p1, s1, *there, *lost


class Explicit(nn.Module):
    """The step in closed form: `herglotz.stepping.explicit`."""

    def __init__(self, model: ContactLagrangian, fused: bool = False):
        super().__init__()
        self.model, self.fused = model, fused

    def forward(
        self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, V: Tensor, slope: Tensor, *more: Tensor
    ) -> tuple[Tensor, ...]:
        """q1, p1, s1, V and V′ there, what rounding took, and c; `more` holds what it took before, then u."""
        taken = 2 if q.dtype == torch.float32 else 0
        lost, u = more[:taken], more[taken:]
        frog = Leapfrog(self.model, inverse, FlatField(LeanField(self.model.potential, self.fused)))
        move = frog(q, p, s[:, 0], h[:, 0], Field(V[:, 0], slope), u[0] if u else None)
        L, c = move.L[:, None], move.c[:, None]
        change, gain = (move.delta + lost[0], L + lost[1]) if lost else (move.delta, L)
        q1, s1 = q + change, s + gain
        lost = (change - (q1 - q), gain - (s1 - s)) if lost else ()
        return q1, move.p1, s1, move.there.V[:, None], move.there.slope, *lost, c


class Inverse:
    """J⁻¹ of (B, n, n) as a function of vectors, without row exchanges; not finite where it fails.

    Where a pivot is small, so is what it proves: what is left says so, and Newton's iteration, which exchanges rows,
    takes over.
    """

    def __init__(self, J: Tensor):
        n = J.shape[-1]
        self.matrix = None
        if n == 1:
            self.columns = [1 / J[..., 0]]
        elif n == 2:
            (a, b), (c, d) = ((row[..., :1], row[..., 1:]) for row in (J[..., 0, :], J[..., 1, :]))
            rate = 1 / (a * d - b * c)
            self.columns = [torch.cat([d, -c], -1) * rate, torch.cat([-b, a], -1) * rate]
        else:
            self.matrix = inverse(J)

    def __call__(self, x: Tensor) -> Tensor:
        """J⁻¹ x, (B, n)."""
        if self.matrix is not None:
            return (self.matrix * x[..., None, :]).sum(-1)
        terms = [column * x[..., i : i + 1] for i, column in enumerate(self.columns)]
        return sum(terms[1:], terms[0])


def continuation(q: Tensor) -> Tensor:
    """(6n, n): from the last misses, side by side and the latest first, to the next."""
    eye = torch.eye(q.shape[-1], dtype=q.dtype, device=q.device)
    return torch.cat([weight * eye for weight in WEIGHTS])


def plans(model: ContactLagrangian) -> list[Plan]:
    """What may be tried, the cheapest first."""
    lean = [Plan(True, k) for k in (2, 3)] if is_lean(model) else []
    return [*lean, *(Plan(False, k) for k in (2, 3, 4))]


def best_plan(
    model: ContactLagrangian, h: float, box: Mapping[str, Sequence[float]] | None, starts: int = 12, steps: int = 18
) -> Plan:
    """The cheapest plan that solves nearly all steps h of a few motions from the box, or else the one that solves most.

    Only speed depends on it: what an attempt leaves is judged at every step.
    """
    if model.capabilities.explicit:
        return Plan(True, 2)  # not used: the step is explicit
    if model.config.order == 4:
        return Plan(False, 0)  # an evaluation is a thousand operations: one copy of it in the file, Newton's
    share: list[float] = []
    x = _drawn(model, box, starts)
    n = model.config.dof
    u = (x.new_zeros(starts, model.config.inputs),) if model.config.inputs else ()
    with torch.no_grad():
        inputs = x.new_zeros(steps, model.config.inputs) if u else None
        run = Stepper(model).rollout(x[:, :n], x[:, n : 2 * n], x[:, -1], h=h, steps=steps, inputs=inputs)
        column = torch.full_like(x[:, :1], h)
        for plan in plans(model):
            attempt, solved, misses = Attempt(model, plan), [], torch.zeros(starts, HISTORY * n, dtype=x.dtype)
            for k in range(steps):
                q, p, s = run.q[:, k], run.p[:, k], run.s[:, k, None]
                here: tuple[Tensor, ...] = ()
                if model.capabilities.by_terms:
                    here = LeanField(model.potential)(q)
                delta, _, _, _, *iterates, size = attempt(q, p, s, column, misses, *here, *u)
                known = run.q[:, k + 1] - q
                misses = torch.cat([known - (delta - iterates[0]), misses[:, : (HISTORY - 1) * n]], -1)
                left, last = increments(*iterates)
                solved.append(~unsolved(left, last, delta, size, TOLERANCE * torch.finfo(x.dtype).eps))
            share.append(float(torch.stack(solved)[HISTORY:].double().mean()))
            if share[-1] > ENOUGH:
                break
    return plans(model)[max(range(len(share)), key=share.__getitem__)]


def _drawn(model: ContactLagrangian, box: Mapping[str, Sequence[float]] | None, count: int) -> Tensor:
    """States (count, 2n + 1) from the middle half of the box, or from [−½, ½]."""
    dtype, n = next(model.parameters()).dtype, model.config.dof
    unit = torch.rand(count, 2 * n + 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    low, high = torch.full((2 * n + 1,), -1.0, dtype=torch.float64), torch.ones(2 * n + 1, dtype=torch.float64)
    if box is not None:
        low, high = (torch.tensor([*box[f"q_{x}"], *box[f"p_{x}"], *box[f"s_{x}"]]).double() for x in ("low", "high"))
    return (low + (high - low) * (0.25 + unit / 2)).to(dtype)
