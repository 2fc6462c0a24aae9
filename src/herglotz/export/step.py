"""One step of a model as a few traced functions: what every rollout loop in a `.pt2` or ONNX file is made of.

    start    (q, p, s) → carry
    begin    (h, carry) → Newton's first carry           only where a step iterates
             (q, p, s, h, u) → the same, K and w/K       where dry friction can hold a coordinate
    iterate  (q, p, s, h, Newton's carry, …) → Newton's carry
    finish   (h, u, carry[, Newton's last carry]) → carry, then c[, residual, status]
    report   (h, q, p, s, q1, p1, s1, c[, residual, status]) → the file's outputs

The carry is q, p, s; then V and V′ at q where the model's terms are known; then the last velocities where a guess
continues them; then, in float32, what rounding took from q and s (Kahan's sum; without it a digit is lost every ten
steps). Vectors are (B, n), numbers a sample (B,).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from herglotz.export.box import Box, Report
from herglotz.export.equation import Terms, dense, example, inverse, length
from herglotz.export.newton import CARRIED, CONVERGED, NewtonIteration, Values, first_carry, status_of
from herglotz.export.trace import traced
from herglotz.models import ContactLagrangian
from herglotz.stepping import State
from herglotz.stepping.explicit import Leapfrog
from herglotz.stepping.field import Field, FieldOf
from herglotz.stepping.partials_equation import PartialsEquation
from herglotz.stepping.stick_slip import at_rest

# The guess of Δ/h continues the parabola through the last velocities. Measured at h = 0.1 (16×2 networks, linear,
# affine and full): 3.0 evaluations a step with three to five velocities, 2.0 to 3.0 with six; where steps differ
# tenfold, 3.0 to 3.6 with three and 3.2 to 3.9 with six, which amplify the difference.
CONTINUE = (3.0, -3.0, 1.0)
STATE = 3  # q, p, s


class Layout:
    """Which tensors the carry of a model holds, and where."""

    def __init__(self, model: ContactLagrangian):
        made_of = model.capabilities
        self.field = 2 * made_of.by_terms  # V and V′
        self.iterates = not made_of.explicit
        self.sticks = made_of.sticking  # the iteration has a start of its own
        self.trail = self.iterates and not self.sticks
        self.compensated = next(model.parameters()).dtype == torch.float32
        self.size = STATE + self.field + self.trail + 2 * self.compensated

    def split(self, carry: Sequence[Tensor]) -> tuple[Values, Values, Values, Values]:
        """(q, p, s), (V, V′), (velocities,) and (lost of q, lost of s), each empty where the model has none."""
        ends = (STATE, STATE + self.field, STATE + self.field + self.trail, self.size)
        return tuple(tuple(carry[a:b]) for a, b in zip((0, *ends), ends, strict=False))  # pyright: ignore


class Start(nn.Module):
    """The carry before the first step."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.model, self.layout = model, Layout(model)

    def forward(self, q: Tensor, p: Tensor, s: Tensor) -> Values:
        """From a state; the velocities are NaN until there is a step."""
        here = FieldOf(self.model.potential)(q) if self.layout.field else ()
        trail = (torch.full_like(q, torch.nan).repeat(1, len(CONTINUE)),) if self.layout.trail else ()
        lost = (torch.zeros_like(q), torch.zeros_like(s)) if self.layout.compensated else ()
        return tuple(dense(x) for x in (q, p, s, *here, *trail, *lost))


class Begin(nn.Module):
    """Newton's first carry: the last velocities, continued."""

    def forward(self, h: Tensor, trail: Tensor) -> Values:
        """From h (B,) and the last velocities side by side, the latest first, (B, 3n)."""
        n = trail.shape[1] // len(CONTINUE)
        eye = torch.eye(n, dtype=trail.dtype, device=trail.device)
        guess = h[:, None] * (trail @ torch.cat([weight * eye for weight in CONTINUE]))
        return first_carry(torch.where(torch.isfinite(guess), guess, 0.0))


class BeginSticking(nn.Module):
    """Newton's first carry in z, K and w/K: `herglotz.stepping.stick_slip`."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.model = model

    def forward(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor, *u: Tensor) -> Values:
        """From the state, h (B,) and the inputs."""
        equation = Terms(self.model, State(q, p, s), h, u).equation
        assert isinstance(equation, PartialsEquation)
        start, *held = at_rest(equation)
        return *first_carry(start), *(dense(x) for x in held)


class Finish(nn.Module):
    """The next carry, c and, where the step iterates, residual and status."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.model, self.layout = model, Layout(model)

    def forward(self, h: Tensor, *rest: Tensor) -> Values:
        """`rest` is u where the model takes inputs, the carry, and Newton's carry where the step iterates."""
        ends = len(rest) - self.layout.size - CARRIED * self.layout.iterates
        u, rest = rest[:ends], rest[ends:]
        state, here, trail, lost = self.layout.split(rest)
        if self.layout.iterates:
            return self._solved(h, state, trail, lost, rest[self.layout.size :])
        return self._explicit(h, state, here, lost, u)

    def _explicit(self, h: Tensor, state: Values, here: Values, lost: Values, u: Values) -> Values:
        """`herglotz.stepping.explicit`; NaN where h is no step or c = e^{−γh} rounds to 0."""
        q, _, s = state
        move = Leapfrog(self.model, inverse)(State(*state), h, Field(*here), u[0] if u else None)
        good = (h > 0) & torch.isfinite(h) & (move.c != 0)
        q1, *lost_q = _added(q, torch.where(good[:, None], move.delta, torch.nan), lost[:1])
        s1, *lost_s = _added(s, move.L, lost[1:])
        return tuple(dense(x) for x in (q1, move.p1, s1, *move.there, *lost_q, *lost_s, move.c))

    def _solved(self, h: Tensor, state: Values, trail: Values, lost: Values, found: Values) -> Values:
        """The end of a step that iterates: NaN where it failed."""
        (q, _, s), (_, done, x, left, merit, _, _, p1, L, c) = state, found
        residual = length(left)
        status = status_of(h, merit, residual, done, L, c)
        x = torch.where((status == CONVERGED)[:, None], x, torch.nan)
        q1, *lost_q = _added(q, x, lost[:1])
        there: Values = ()
        if self.layout.field:  # what the potential at q1 adds to p1 and L
            V, slope = there = FieldOf(self.model.potential)(q1)
            p1, L = p1 - (h / 2)[:, None] * slope, L - h / 2 * V
        s1, *lost_s = _added(s, L, lost[1:])
        followed = (_followed(trail[0], x / h[:, None]),) if trail else ()
        new = (q1, p1, s1, *there, *followed, *lost_q, *lost_s)
        return tuple(dense(y) for y in (*new, c, residual, status))


def _added(x: Tensor, change: Tensor, lost: Values) -> Values:
    """X + change and, where the sum is compensated, what rounding took from it."""
    if not lost:
        return (x + change,)
    wanted = change + lost[0]
    new = x + wanted
    return new, wanted - (new - x)


def _followed(trail: Tensor, v: Tensor) -> Tensor:
    """The last velocities after another; the first one fills all places."""
    shifted = torch.cat([v, trail[:, : -v.shape[1]]], -1)
    return torch.where(torch.isnan(trail), v.repeat(1, len(CONTINUE)), shifted)


class StepGraphs(nn.Module):
    """The functions of a step, traced, of a model that is not to be trained any more.

    `box` and `h_range` say where it was fitted, for the output `outside` (`herglotz.export.box`).
    """

    def __init__(
        self,
        model: ContactLagrangian,
        box: Mapping[str, Sequence[float]] | None = None,
        h_range: Sequence[float] | None = None,
    ):
        super().__init__()
        layout = self.layout = Layout(model)
        q, p, s, h, *u = example(model, 0.1)
        self.start = traced(Start(model), (q, p, s))
        carry = [y + 0.1 * i for i, y in enumerate(self.start(q, p, s))]
        here = carry[STATE : STATE + layout.field]
        found: list[Tensor] = []
        if layout.iterates:
            found = [y.clone() for y in first_carry(0.1 * p)]
            held: list[Tensor] = []
            if layout.sticks:
                self.begin = traced(BeginSticking(model), (q, p, s, h, *u))
                held = [y + 0.1 * (i + 1) for i, y in enumerate((q, p))]
            else:
                self.begin = traced(Begin(), (h, carry[STATE + layout.field]))
            self.iterate = traced(NewtonIteration(model), (q, p, s, h, *found, *here, *u, *held))
        self.finish = traced(Finish(model), (h, *u, *carry, *found))
        rows = [y + 1 for y in (q, p, s, s + 1)]
        solved = (s + 3, (s > 0).to(torch.uint8)) if layout.iterates else ()
        self.report = traced(Report(Box.of(box, model, h_range)), (h, q, p, s, *rows, *solved))
