"""One step of a model as a few traced functions: what every rollout loop in a `.pt2` or ONNX file is made of.

    start    (q, p, s) → carry
    begin    (h, carry) → Newton's first carry           only where a step iterates
             (q, p, s, h, u) → the same, K and w/K       where dry friction can hold a coordinate
    iterate  (q, p, s, h, Newton's carry, …) → Newton's carry
    finish   (h, u, carry[, Newton's last carry]) → carry, then c[, residual, status]
    report   (h, q, p, s, q1, p1, s1, c[, residual, status]) → the file's outputs

The carry is q, p, s; then V and V′ at q where the model's terms are known; then the last velocities where a guess
continues them; then, in float32, what rounding took from q and s (Kahan's sum; without it a digit is lost every ten
steps). Vectors are (B, n), numbers a sample (B,). Newton's unknown is Δ = q1 − q0, because the difference q1 − q0 would
round a small step away; where dry friction can hold a coordinate it is the z of `herglotz.stepping.stick_slip`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import torch
from torch import Tensor, nn

from herglotz.codegen.trace import traced
from herglotz.export.box import Box, report
from herglotz.export.equation import Terms, dense, example, inverse, length, step_equation
from herglotz.export.metadata import TOLERANCE
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Status
from herglotz.stepping.explicit import Leapfrog
from herglotz.stepping.field import Field, FieldOf
from herglotz.stepping.partials_equation import PartialsEquation
from herglotz.stepping.stick_slip import at_rest

# The guess of Δ/h continues the parabola through the last velocities. Measured at h = 0.1 (16×2 networks, linear,
# affine and full): 3.0 evaluations a step with three to five velocities, 2.0 to 3.0 with six; where steps differ
# tenfold, 3.0 to 3.6 with three and 3.2 to 3.9 with six, which amplify the difference.
CONTINUE = (3.0, -3.0, 1.0)
STATE = 3  # q, p, s
FLOOR = 1000  # machine epsilons of q: rounding in J⁻¹F that no further iteration removes
ITERATIONS = 30  # default bound; a step from a good guess takes two to four
DECREASE = 1e-4  # share of the predicted decrease of |F| that an accepted trial must reach (Armijo's rule)
CARRIED = 10  # tensors between two iterations: count, done, x, delta, merit, fraction, scale, p1, L, c
# Tracing takes plain numbers, not the enumeration.
CONVERGED, MAX_ITERATIONS = int(Status.CONVERGED), int(Status.MAX_ITERATIONS)
SINGULAR, DIVERGED, BAD_INPUT = int(Status.SINGULAR), int(Status.DIVERGED), int(Status.BAD_INPUT)

Values = tuple[Tensor, ...]


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


def first_carry(guess: Tensor) -> Values:
    """The carry before iteration 0, which evaluates the guess of Δ, (B, n)."""
    zero = torch.zeros_like(guess[:, 0])
    return (
        torch.zeros((), dtype=torch.int64, device=guess.device),  # count
        torch.zeros_like(zero, dtype=torch.bool),  # done
        guess,  # x: the accepted Δ
        torch.zeros_like(guess),  # delta: the Newton step from x
        torch.full_like(zero, torch.inf),  # merit: |F| at x
        torch.ones_like(zero),  # fraction of delta that is tried next
        length(guess),  # scale: the size that the tolerance is relative to
        torch.zeros_like(guess),  # p1
        zero,  # L
        torch.zeros_like(zero),  # c
    )


def newton_iteration(model: ContactLagrangian, *arguments: Tensor) -> Values:
    """One iteration with backtracking, one evaluation of the step equation: the next carry.

    The arguments are q, p, s, h, the carry, then V, V′ at q, u, K and w/K as far as the model has them. The rules of
    acceptance are those of `herglotz.mechanics.newton`, whose loop a file cannot hold: that loop decides in Python, for
    all samples at once, whether the last Jacobian still serves and whether a trial was refused at all. Without these
    decisions it takes 1.3 to 1.6 times as long for 16 samples and 1.6 to 1.9 times for 1024 (n = 2, 16×2, levels
    linear, affine and full).
    """
    (q, p, s, h), more = arguments[:4], arguments[4 + CARRIED :]
    count, done, x, delta, merit, fraction, scale, *values = arguments[4 : 4 + CARRIED]
    held = 2 * model.capabilities.sticking  # K and w/K
    eps = torch.finfo(q.dtype).eps
    first = count == 0
    trial = x + torch.where(done[:, None], 0.0, fraction[:, None] * delta)
    delta_trial, size, merit_trial, *values_trial, _ = step_equation(model, held, q, p, s, h, trial, *more)
    left = length(delta_trial)
    scale = torch.where(first, torch.nan_to_num(torch.maximum(scale + size, left), nan=1.0, posinf=1.0), scale)
    better = first | (merit_trial <= (1 - DECREASE * fraction) * merit)
    settled = left <= TOLERANCE * eps * scale
    # The networks' rounding is relative to h times the top speed, even at rest.
    rounding = FLOOR * eps * torch.maximum(torch.maximum(scale, length(q)), max(model.config.speed) * h)
    stalled = ~better & (length(delta) <= rounding)  # rounding, not a wrong direction
    # No direction to follow; as in `status_of`, for a sum of two large numbers may overflow where neither does.
    hopeless = first & ~(torch.isfinite(merit_trial) & torch.isfinite(left))
    accept = ~done & (better | settled)
    pairs = zip((trial, delta_trial, merit_trial, *values_trial), (x, delta, merit, *values), strict=True)
    x, delta, merit, *values = (torch.where(accept[:, None] if a.ndim > 1 else accept, a, b) for a, b in pairs)
    fraction = torch.where(accept, 1.0, fraction / 2)
    found = (done | settled | stalled | hopeless, x, delta, merit, fraction, scale, *values)
    return count + 1, *(dense(y) for y in found)


def unfinished(count: Tensor, done: Tensor, iterations: int) -> Tensor:
    """Whether another iteration is needed, a scalar bool."""
    return (count <= iterations) & ~done.all()


def status_of(h: Tensor, merit: Tensor, residual: Tensor, done: Tensor, L: Tensor, c: Tensor) -> Tensor:
    """The status of each sample by the rules of the eager solver, uint8; BAD_INPUT where h is no step."""
    status = torch.where(done, CONVERGED, MAX_ITERATIONS)
    status = torch.where(torch.isfinite(residual) & (c != 0), status, SINGULAR)
    status = torch.where(torch.isfinite(merit) & torch.isfinite(L), status, DIVERGED)
    return torch.where((h > 0) & torch.isfinite(h), status, BAD_INPUT).to(torch.uint8)


def start(model: ContactLagrangian, q: Tensor, p: Tensor, s: Tensor) -> Values:
    """The carry before the first step; the velocities are NaN until there is a step."""
    layout = Layout(model)
    here = FieldOf(model.potential)(q) if layout.field else ()
    trail = (torch.full_like(q, torch.nan).repeat(1, len(CONTINUE)),) if layout.trail else ()
    lost = (torch.zeros_like(q), torch.zeros_like(s)) if layout.compensated else ()
    return tuple(dense(x) for x in (q, p, s, *here, *trail, *lost))


def begin(h: Tensor, trail: Tensor) -> Values:
    """Newton's first carry from h (B,) and the last velocities side by side, the latest first, (B, 3n)."""
    n = trail.shape[1] // len(CONTINUE)
    eye = torch.eye(n, dtype=trail.dtype, device=trail.device)
    guess = h[:, None] * (trail @ torch.cat([weight * eye for weight in CONTINUE]))
    return first_carry(torch.where(torch.isfinite(guess), guess, 0.0))


def begin_sticking(model: ContactLagrangian, q: Tensor, p: Tensor, s: Tensor, h: Tensor, *u: Tensor) -> Values:
    """Newton's first carry in z, K and w/K: `herglotz.stepping.stick_slip`."""
    equation = Terms(model, State(q, p, s), h, u).equation
    assert isinstance(equation, PartialsEquation)
    z, *held = at_rest(equation)
    return *first_carry(z), *(dense(x) for x in held)


def finish(model: ContactLagrangian, h: Tensor, *rest: Tensor) -> Values:
    """The next carry, c and, where the step iterates, residual and status.

    `rest` is u where the model takes inputs, the carry, and Newton's carry where the step iterates.
    """
    layout = Layout(model)
    ends = len(rest) - layout.size - CARRIED * layout.iterates
    u, rest = rest[:ends], rest[ends:]
    state, here, trail, lost = layout.split(rest)
    if layout.iterates:
        return _solved(model, h, (state, trail, lost), rest[layout.size :])
    return _explicit(model, h, (state, here, lost), u)


def _explicit(model: ContactLagrangian, h: Tensor, carry: tuple[Values, ...], u: Values) -> Values:
    """`herglotz.stepping.explicit`; NaN where h is no step or c = e^{−γh} rounds to 0."""
    state, here, lost = carry
    move = Leapfrog(model, inverse)(State(*state), h, Field(*here), u[0] if u else None)
    good = (h > 0) & torch.isfinite(h) & (move.c != 0)
    q1, *lost_q = _added(state[0], torch.where(good[:, None], move.delta, torch.nan), lost[:1])
    s1, *lost_s = _added(state[2], move.L, lost[1:])
    return tuple(dense(x) for x in (q1, move.p1, s1, *move.there, *lost_q, *lost_s, move.c))


def _solved(model: ContactLagrangian, h: Tensor, carry: tuple[Values, ...], found: Values) -> Values:
    """The end of a step that iterates: NaN where it failed."""
    ((q, _, s), trail, lost), (_, done, x, left, merit, _, _, p1, L, c) = carry, found
    residual = length(left)
    status = status_of(h, merit, residual, done, L, c)
    x = torch.where((status == CONVERGED)[:, None], x, torch.nan)
    q1, *lost_q = _added(q, x, lost[:1])
    there: Values = ()
    if model.capabilities.by_terms:  # what the potential at q1 adds to p1 and L
        V, slope = there = FieldOf(model.potential)(q1)
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
        self.inputs = len(u)
        self.start = traced(partial(start, model), (q, p, s))
        carry = [y + 0.1 * i for i, y in enumerate(self.start(q, p, s))]
        here = carry[STATE : STATE + layout.field]
        found: list[Tensor] = []
        if layout.iterates:
            found = [y.clone() for y in first_carry(0.1 * p)]
            held: list[Tensor] = []
            if layout.sticks:
                self.begin = traced(partial(begin_sticking, model), (q, p, s, h, *u))
                held = [y + 0.1 * (i + 1) for i, y in enumerate((q, p))]
            else:
                self.begin = traced(begin, (h, carry[STATE + layout.field]))
            self.iterate = traced(partial(newton_iteration, model), (q, p, s, h, *found, *here, *u, *held))
        self.finish = traced(partial(finish, model), (h, *u, *carry, *found))
        rows = [y + 1 for y in (q, p, s, s + 1)]
        solved = (s + 3, (s > 0).to(torch.uint8)) if layout.iterates else ()
        self.report = traced(partial(report, Box.of(box, model, h_range)), (h, q, p, s, *rows, *solved))
