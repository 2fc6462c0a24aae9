"""Newton's iteration on the step equation as a loop of tensor operations, and what it says of how it went."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch._higher_order_ops.while_loop import while_loop_op

from herglotz.export.equation import dense, length
from herglotz.export.metadata import TOLERANCE
from herglotz.export.trace import Graph
from herglotz.stepping import Status

FLOOR = 1000  # machine epsilons of q: rounding in J⁻¹F that no further iteration removes
ITERATIONS = 30
# Plain numbers: tracing does not know the enumeration.
CONVERGED, MAX_ITERATIONS = int(Status.CONVERGED), int(Status.MAX_ITERATIONS)
SINGULAR, DIVERGED = int(Status.SINGULAR), int(Status.DIVERGED)
BAD_INPUT = 5  # only where nothing checks h before the graph does; the loaders raise

Values = tuple[Tensor, ...]


class Newton(nn.Module):
    """Newton with backtracking on the step equation by the rules of the eager solver, one evaluation in the graph.

    The unknown is Δ = q1 − q0: where a step is small, q1 − q0 would round it away. The carry is (count, done, x, delta,
    merit, fraction, scale, p1, L, c, …): an accepted x = Δ, the Newton step from it, |F|, the fraction of a step tried
    next and the size that the tolerance is relative to. Iteration 0 evaluates the guess itself.

    Parameters
    ----------
    equation
        `StepEquation` as a graph, with or without J.
    iterations
        Bound on the iterations.
    speed
        The data's top speed: the networks' rounding is relative to h times this, even at rest.
    """

    def __init__(self, equation: Graph, iterations: int, speed: float):
        super().__init__()
        self.equation, self.speed = equation, speed
        self.iterations = iterations

    def start(self, q: Tensor, s: Tensor, guess: Tensor, with_J: bool = False) -> Values:
        """The carry before iteration 0; `guess` is one of Δ."""
        zero = torch.zeros_like(s)
        return (
            torch.zeros((), dtype=torch.int64, device=q.device),
            torch.zeros_like(s, dtype=torch.bool),
            dense(guess),
            torch.zeros_like(q),
            torch.full_like(s, torch.inf),
            torch.ones_like(s),
            length(guess),
            torch.zeros_like(q),
            zero,
            zero.clone(),
            *((torch.zeros_like(q[..., None] * q[..., None, :]),) if with_J else ()),
        )

    def proceed(self, attempted: Values, s: Tensor) -> Values:
        """The carry after an attempt: samples that it has not solved start anew at its Δ, lost ones are over.

        `attempted` is Δ, p1 (B, n), L, c, the last two increments' sizes, and whether they were too much (B, 1).
        """
        x, p1, L, c, left, last, bad = attempted
        over = (~bad | (s != s))[:, 0]
        count, _, _, _, merit, fraction, *_ = self.start(x, s[:, 0], x)
        rest = remainder(left, last)
        merit = torch.where(over, 0.0 * rest[:, 0], merit)  # NaN where a sample was lost before this step
        delta = torch.where(over[:, None], rest.expand(x.shape), 0.0)
        x = torch.where(torch.isfinite(x), x, 0.0)
        # Every entry is computed: a loop that makes no turn leaves its results in the memory of what it started from,
        # where inductor may put something else; none of that may be what the attempt has found.
        done = over | (left[:, 0] < 0)
        p1 = torch.where(over[:, None], p1, 0.0)
        L, c = torch.where(over, L[:, 0], 0.0), torch.where(over, c[:, 0], 1.0)
        return count, done, x, delta, merit, fraction, length(x), p1, L, c

    def unfinished(self, count: Tensor, done: Tensor) -> Tensor:
        """Whether another iteration is needed, a scalar bool."""
        return (count <= self.iterations) & ~done.all()

    def iterate(self, problem: Values, carry: Values, constants: Values) -> Values:
        """One iteration; `problem` is (q, p, s, h, V, V′, u), as far as there are such, `constants` the equation's."""
        q, p, s, h, *more = problem
        count, done, x, delta, merit, fraction, scale, *values = carry
        eps = torch.finfo(q.dtype).eps
        first = count == 0
        trial = x + torch.where(done[..., None], 0.0, fraction[..., None] * delta)
        delta_trial, size, merit_trial, *values_trial = self.equation.call(q, p, s, h, trial, *more, *constants)
        left = length(delta_trial)
        scale = torch.where(first, torch.nan_to_num(torch.maximum(scale + size, left), nan=1.0, posinf=1.0), scale)
        better = first | (merit_trial <= (1 - 1e-4 * fraction) * merit)
        settled = left <= TOLERANCE * eps * scale
        rounding = FLOOR * eps * torch.maximum(torch.maximum(scale, length(q)), self.speed * h)
        stalled = ~better & (length(delta) <= rounding)  # not a wrong direction
        hopeless = first & ~torch.isfinite(merit_trial + left)  # there is no direction to follow
        accept = ~done & (better | settled)
        new = ((trial, x), (delta_trial, delta), (merit_trial, merit))
        new = (*new, *zip(values_trial, values, strict=True))
        x, delta, merit, *values = (dense(torch.where(_like(accept, a), a, b)) for a, b in new)
        fraction = torch.where(accept, 1.0, fraction / 2)
        return count + 1, done | settled | stalled | hopeless, x, delta, merit, fraction, scale.clone(), *values

    def forward(self, problem: Values, carry: Values, constants: Values) -> Values:
        """Iterate to the end: Δ, delta, merit, done, p1, L, c, …."""
        ends = len(carry), len(carry) + len(problem)

        def turn(*x: Tensor) -> Values:
            return self.iterate(x[ends[0] : ends[1]], x[: ends[0]], x[ends[1] :])

        # The operator itself: its wrapper would first have dynamo trace the loop, which takes longer than all else.
        more: Any = (*problem, *constants)
        start: Any = tuple(dense(x) for x in carry)
        ended = while_loop_op(lambda *x: self.unfinished(x[0], x[1]), turn, start, more)
        _, done, x, delta, merit, _, _, *values = ended
        return x, delta, merit, done, *values


def remainder(left: Tensor, last: Tensor) -> Tensor:
    """What an increment leaves after another: |J⁻¹F|, by the rate at which they shrink."""
    return torch.where(left == 0, left, left * left / last)


def status_of(h: Tensor, merit: Tensor, residual: Tensor, done: Tensor, L: Tensor, c: Tensor) -> Tensor:
    """The status of each sample by the rules of the eager solver, uint8; 5, as in C, where h is no step."""
    status = torch.where(done, CONVERGED, MAX_ITERATIONS)
    status = torch.where(torch.isfinite(residual) & (c != 0), status, SINGULAR)
    status = torch.where(torch.isfinite(merit) & torch.isfinite(L), status, DIVERGED)
    return torch.where((h > 0) & torch.isfinite(h), status, BAD_INPUT).to(torch.uint8)


def _like(mask: Tensor, x: Tensor) -> Tensor:
    return mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim))
