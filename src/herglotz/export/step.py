"""One step of a model as a few traced functions, from which the rollout loops of `.pt2` and ONNX files are made.

    start    (q, p, s) → carry
    begin    (h, carry) → Newton's first carry           only where a step iterates
             (q, p, s, h, u) → the same, K and w/K       where dry friction can hold a coordinate
    iterate  (q, p, s, h, Newton's carry, …) → Newton's carry
    finish   (h, u, carry[, Newton's last carry]) → carry, then the file's outputs

The carry is q, p, s; then V and V′ at q where the model's terms are known; then the last velocities where the guess
continues them; then, in float32, the rounding errors of q and s (Kahan's sum; without it a digit is lost every ten
steps). Vectors are (B, n), scalars of a sample (B,). Newton's unknown is Δ = q1 − q0, because the difference q1 − q0
would lose the digits of a small step; where dry friction can hold a coordinate, the unknown is the z of
`herglotz.stepping.newton.StickSlip`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from herglotz.codegen.trace import traced
from herglotz.export.equation import dense, equation_of, example, inverse, length, step_equation
from herglotz.export.metadata import TOLERANCE
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Status
from herglotz.stepping.equation import PartialsEquation
from herglotz.stepping.explicit import Field, FieldOf, Leapfrog
from herglotz.stepping.newton import at_rest

# The guess of Δ/h extrapolates the parabola through the last velocities. Measured at h = 0.1 (16×2 networks, linear,
# affine and full): 3.0 evaluations a step with three to five velocities, 2.0 to 3.0 with six. Where step sizes differ
# tenfold: 3.0 to 3.6 with three velocities and 3.2 to 3.9 with six, which amplify the difference.
EXTRAPOLATION = (3.0, -3.0, 1.0)
# The first tensors of every carry: q, p, s.
STATE = 3
# Rounding of J⁻¹F in machine epsilons of q; no further iteration makes J⁻¹F smaller.
ROUNDING_EPSILONS = 1000
# The default bound; a step from a good guess takes two to four iterations.
MAX_ITERATIONS = 30
# Armijo's rule: an accepted trial reaches at least this share of the predicted decrease of |F|.
MIN_DECREASE = 1e-4
# Tensors handed from one iteration to the next: count, done, x, delta, merit, fraction, scale, p1, L, c.
CARRIED = 10

Values = tuple[Tensor, ...]


class Layout:
    """Which tensors the carry of a model holds, and where."""

    def __init__(self, model: ContactLagrangian):
        capabilities = model.capabilities
        # V and V′ are two tensors.
        self.field = 2 * capabilities.by_terms
        self.iterates = not capabilities.explicit
        self.sticks = capabilities.sticking
        # A sticking step starts from the equation at rest, not from the last velocities.
        self.trail = self.iterates and not self.sticks
        self.compensated = next(model.parameters()).dtype == torch.float32
        self.size = STATE + self.field + self.trail + 2 * self.compensated

    def split(self, carry: Sequence[Tensor]) -> tuple[Values, Values, Values, Values]:
        """(q, p, s), (V, V′), (velocities,) and (error of q, error of s), each empty where the carry has none."""
        ends = (STATE, STATE + self.field, STATE + self.field + self.trail, self.size)
        return tuple(tuple(carry[a:b]) for a, b in zip((0, *ends), ends, strict=False))  # pyright: ignore


def first_carry(guess: Tensor) -> Values:
    """The carry before iteration 0, which evaluates the guess of Δ, (B, n).

    x is the accepted Δ, delta the Newton step from x, merit |F| at x, fraction the part of delta that is tried next,
    scale the size that the tolerance is relative to; p1, L and c are those at x.
    """
    zero = torch.zeros_like(guess[:, 0])
    count, done = torch.zeros((), dtype=torch.int64, device=guess.device), torch.zeros_like(zero, dtype=torch.bool)
    delta, merit, fraction = torch.zeros_like(guess), torch.full_like(zero, torch.inf), torch.ones_like(zero)
    p1, L, c = torch.zeros_like(guess), zero, torch.zeros_like(zero)
    return count, done, guess, delta, merit, fraction, length(guess), p1, L, c


def newton_iteration(model: ContactLagrangian, *arguments: Tensor) -> Values:
    """One iteration with backtracking, one evaluation of the step equation: the next carry.

    The arguments are q, p, s, h, the carry, then V, V′ at q, u, K and w/K as far as the model has them. The rules of
    acceptance are those of `herglotz.mechanics.newton`, whose loop a file cannot hold: that loop decides in Python, for
    all samples at once, whether the last Jacobian is kept and whether a trial was refused at all. Without these
    decisions a step takes 1.3 to 1.6 times as long for 16 samples and 1.6 to 1.9 times for 1024 (n = 2, 16×2, levels
    linear, affine and full).
    """
    (q, p, s, h), more = arguments[:4], arguments[4 + CARRIED :]
    count, done, x, delta, merit, fraction, scale, *values = arguments[4 : 4 + CARRIED]
    # K and w/K are two tensors.
    bounds = 2 * model.capabilities.sticking
    eps = torch.finfo(q.dtype).eps
    first = count == 0
    trial = x + torch.where(done[:, None], 0.0, fraction[:, None] * delta)
    delta_trial, size, merit_trial, *values_trial, _ = step_equation(model, bounds, q, p, s, h, trial, *more)
    residual = length(delta_trial)
    scale = torch.where(first, torch.nan_to_num(torch.maximum(scale + size, residual), nan=1.0, posinf=1.0), scale)
    better = first | (merit_trial <= (1 - MIN_DECREASE * fraction) * merit)
    settled = residual <= TOLERANCE * eps * scale
    # The networks' rounding is relative to h times the top speed, even at rest.
    rounding = ROUNDING_EPSILONS * eps * torch.maximum(torch.maximum(scale, length(q)), max(model.config.speed) * h)
    # A refused trial this near to x was refused by rounding, not by a wrong direction.
    stalled = ~better & (length(delta) <= rounding)
    # At a guess that is not finite no direction exists. Two tests, as in `status_of`: a sum of two large finite numbers
    # may overflow.
    hopeless = first & ~(torch.isfinite(merit_trial) & torch.isfinite(residual))
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
    """The status of each sample by the rules of the eager solver, uint8; BAD_INPUT where h is not a finite h > 0."""
    # Tracing takes plain numbers, not the enumeration.
    status = torch.where(done, int(Status.CONVERGED), int(Status.MAX_ITERATIONS))
    status = torch.where(torch.isfinite(residual) & (c != 0), status, int(Status.SINGULAR))
    status = torch.where(torch.isfinite(merit) & torch.isfinite(L), status, int(Status.DIVERGED))
    return torch.where((h > 0) & torch.isfinite(h), status, int(Status.BAD_INPUT)).to(torch.uint8)


def start(model: ContactLagrangian, q: Tensor, p: Tensor, s: Tensor) -> Values:
    """The carry before the first step; the velocities are NaN until a step was made."""
    layout = Layout(model)
    field = FieldOf(model.potential)(q) if layout.field else ()
    trail = (torch.full_like(q, torch.nan).repeat(1, len(EXTRAPOLATION)),) if layout.trail else ()
    errors = (torch.zeros_like(q), torch.zeros_like(s)) if layout.compensated else ()
    return tuple(dense(x) for x in (q, p, s, *field, *trail, *errors))


def begin(h: Tensor, trail: Tensor) -> Values:
    """Newton's first carry from h (B,) and the last velocities side by side, the latest first, (B, 3n)."""
    n = trail.shape[1] // len(EXTRAPOLATION)
    eye = torch.eye(n, dtype=trail.dtype, device=trail.device)
    guess = h[:, None] * (trail @ torch.cat([weight * eye for weight in EXTRAPOLATION]))
    return first_carry(torch.where(torch.isfinite(guess), guess, 0.0))


def begin_sticking(model: ContactLagrangian, q: Tensor, p: Tensor, s: Tensor, h: Tensor, *u: Tensor) -> Values:
    """Newton's first carry in z, K and w/K: `herglotz.stepping.newton.StickSlip`."""
    equation = equation_of(model, State(q, p, s), h, u)
    assert isinstance(equation, PartialsEquation)
    z, *bounds = at_rest(equation)
    return *first_carry(z), *(dense(x) for x in bounds)


def finish(model: ContactLagrangian, box: Box | None, h: Tensor, *rest: Tensor) -> Values:
    """The next carry, and the outputs of a step (`report`).

    `rest` is u where the model takes inputs, the carry, and Newton's carry where the step iterates.
    """
    layout = Layout(model)
    split = len(rest) - layout.size - CARRIED * layout.iterates
    u, rest = rest[:split], rest[split:]
    state, field, trail, errors = layout.split(rest)
    if layout.iterates:
        new = _solved(model, h, (state, trail, errors), rest[layout.size :])
    else:
        new = _explicit(model, h, (state, field, errors), u)
    outputs = report(box, h, state, new[:STATE], *new[layout.size :])
    return tuple(dense(x) for x in (*new[: layout.size], *outputs))


def _explicit(model: ContactLagrangian, h: Tensor, carry: tuple[Values, ...], u: Values) -> Values:
    """A step of `herglotz.stepping.explicit`; NaN where h is not a finite h > 0 or c = e^{−γh} rounds to 0."""
    state, field, errors = carry
    move = Leapfrog(model, inverse)(State(*state), h, Field(*field), u[0] if u else None)
    good = (h > 0) & torch.isfinite(h) & (move.c != 0)
    q1, *error_q = _added(state[0], torch.where(good[:, None], move.delta, torch.nan), errors[:1])
    s1, *error_s = _added(state[2], move.L, errors[1:])
    return q1, move.p1, s1, *move.there, *error_q, *error_s, move.c


def _solved(model: ContactLagrangian, h: Tensor, carry: tuple[Values, ...], found: Values) -> Values:
    """The end of a step that iterates: NaN where it failed."""
    ((q, _, s), trail, errors), (_, done, x, newton_step, merit, _, _, p1, L, c) = carry, found
    residual = length(newton_step)
    status = status_of(h, merit, residual, done, L, c)
    x = torch.where((status == int(Status.CONVERGED))[:, None], x, torch.nan)
    q1, *error_q = _added(q, x, errors[:1])
    field: Values = ()
    if model.capabilities.by_terms:
        # The share of the potential at q1 in p1 and L.
        V, slope = field = FieldOf(model.potential)(q1)
        p1, L = p1 - (h / 2)[:, None] * slope, L - h / 2 * V
    s1, *error_s = _added(s, L, errors[1:])
    velocities = (_appended(trail[0], x / h[:, None]),) if trail else ()
    return q1, p1, s1, *field, *velocities, *error_q, *error_s, c, residual, status


def _added(x: Tensor, change: Tensor, error: Values) -> Values:
    """The sum x + change and, where the sum is compensated, its new rounding error."""
    if not error:
        return (x + change,)
    wanted = change + error[0]
    new = x + wanted
    return new, wanted - (new - x)


def _appended(trail: Tensor, v: Tensor) -> Tensor:
    """The last velocities with v in front; the velocity of the first step fills all places."""
    shifted = torch.cat([v, trail[:, : -v.shape[1]]], -1)
    return torch.where(torch.isnan(trail), v.repeat(1, len(EXTRAPOLATION)), shifted)


class StepGraphs(nn.Module):
    """The traced functions of a step, of a model that is not trained any more.

    `box` and `h_range` are those that the model was fitted in, for the output `outside` (`Box`).
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
        field = carry[STATE : STATE + layout.field]
        found: list[Tensor] = []
        if layout.iterates:
            found = [y.clone() for y in first_carry(0.1 * p)]
            bounds: list[Tensor] = []
            if layout.sticks:
                self.begin = traced(partial(begin_sticking, model), (q, p, s, h, *u))
                bounds = [y + 0.1 * (i + 1) for i, y in enumerate((q, p))]
            else:
                self.begin = traced(begin, (h, carry[STATE + layout.field]))
            self.iterate = traced(partial(newton_iteration, model), (q, p, s, h, *found, *field, *u, *bounds))
        self.finish = traced(partial(finish, model, Box.of(box, model, h_range)), (h, *u, *carry, *found))


class Box:
    """The box of states that the model was fitted in; angles count modulo 2π.

    `h_range` is (low, high), or None for any step. The action s grows without bound; `by_s` is true where the motion
    depends on s, and only then s counts.
    """

    def __init__(
        self,
        box: Mapping[str, Sequence[float]],
        angles: Sequence[bool],
        dtype: torch.dtype,
        h_range: Sequence[float] | None = None,
        by_s: bool = True,
    ):
        self.by_s = by_s
        names = "qps" if by_s else "qp"
        low, high = (
            torch.tensor([x for name in names for x in box[f"{name}_{end}"]], dtype=torch.float64)
            for end in ("low", "high")
        )
        turn = torch.zeros_like(low)
        turn[: len(angles)] = torch.tensor([2 * math.pi * bool(a) for a in angles], dtype=torch.float64)
        turns_per_radian = torch.where(turn > 0, 1 / turn, 0.0)
        values = low, high, turn, turns_per_radian
        self.low, self.high, self.turn, self.turns_per_radian = (x.to(dtype) for x in values)
        self.span = None if h_range is None else torch.tensor(h_range, dtype=dtype)

    @classmethod
    def of(
        cls, box: Mapping[str, Sequence[float]] | None, model: ContactLagrangian, h_range: Sequence[float] | None = None
    ) -> Box | None:
        """The box of a model; None where no box is recorded."""
        if box is None:
            return None
        return cls(box, model.config.angles, next(model.parameters()).dtype, h_range, model.s_enters_motion)

    def __call__(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """(...) True where a state lies outside the box or has a NaN."""
        x = torch.cat([q, p, s[..., None]] if self.by_s else [q, p], -1)
        x = x - self.turn * torch.round((x - (self.low + self.high) / 2) * self.turns_per_radian)
        return ~((x >= self.low) & (x <= self.high)).all(-1)

    def flags(self, h: Tensor, before: tuple[Tensor, ...], after: tuple[Tensor, ...]) -> Tensor:
        """(...) uint8: 1 where a step starts or ends outside the box, plus 2 where h is outside `h_range`."""
        flags = (self(*before) | self(*after)).to(torch.uint8)
        if self.span is None:
            return flags
        return torch.where((h >= self.span[0]) & (h <= self.span[1]), flags, flags + 2)


def s_matters(metadata: Mapping[str, Any]) -> bool:
    """Whether the motion of a file's model depends on s; the model's level decides."""
    return metadata.get("level") in ("affine", "full")


def report(box: Box | None, h: Tensor, before: Values, after: Values, c: Tensor, *solved: Tensor) -> Values:
    """The outputs of a step, q1, p1, s1, c, residual, status[, outside]; the first four are NaN where the step failed.

    `before` and `after` are (q, p, s), `solved` the residual and the status of steps that iterate.
    """
    q1, p1, s1 = after
    residual, newton_status = solved or (0.0 * c, None)
    finite = torch.isfinite(residual + s1) & torch.isfinite(q1 + p1).all(-1)
    status = torch.where(finite, int(Status.CONVERGED), int(Status.DIVERGED)).to(torch.uint8)
    if newton_status is not None:
        status = torch.where(newton_status != int(Status.CONVERGED), newton_status, status)
    status = torch.where(c == 0, int(Status.SINGULAR), status)
    status = torch.where((h > 0) & torch.isfinite(h), status, int(Status.BAD_INPUT)).to(torch.uint8)
    nan = torch.where(status == int(Status.CONVERGED), 0.0, torch.nan).to(q1.dtype)
    new = (q1 + nan[:, None], p1 + nan[:, None], s1 + nan)
    outside = () if box is None else (box.flags(h, before, new),)
    return *new, c + nan, residual, status, *outside
