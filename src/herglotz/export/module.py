"""Steps, rollouts and starts of the flow Φ̃ as modules of plain tensor operations: what exported files contain."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch._higher_order_ops.scan import scan_op
from torch._higher_order_ops.while_loop import while_loop_op

from herglotz.errors import InputError
from herglotz.export.equation import Equations, dense, eliminate, length
from herglotz.export.metadata import TOLERANCE
from herglotz.export.trace import Graph
from herglotz.models import ContactLagrangian
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
        `StepEquation` as a graph, with or without its slopes.
    iterations
        Bound on the iterations.
    """

    def __init__(self, equation: Graph, iterations: int):
        super().__init__()
        self.equation = equation
        self.iterations = iterations

    def start(self, q: Tensor, s: Tensor, guess: Tensor, slopes: bool = False) -> Values:
        """The carry before iteration 0; `guess` is one of Δ."""
        zero, matrix = torch.zeros_like(s), torch.zeros_like(q[..., None] * q[..., None, :])
        more = (matrix, matrix.clone(), torch.zeros_like(q)) if slopes else ()
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
            *more,
        )

    def unfinished(self, count: Tensor, done: Tensor) -> Tensor:
        """Whether another iteration is needed, a scalar bool."""
        return (count <= self.iterations) & ~done.all()

    def iterate(self, problem: Values, carry: Values, constants: Values) -> Values:
        """One iteration; `problem` is (q, p, s, h[, u]), `constants` those of the equation."""
        q, p, s, h, *u = problem
        count, done, x, delta, merit, fraction, scale, *values = carry
        eps = torch.finfo(q.dtype).eps
        first = count == 0
        trial = x + torch.where(done[..., None], 0.0, fraction[..., None] * delta)
        delta_trial, size, merit_trial, *values_trial = self.equation.call(q, p, s, h, trial, *u, *constants)
        left = length(delta_trial)
        scale = torch.where(first, torch.nan_to_num(torch.maximum(scale + size, left), nan=1.0, posinf=1.0), scale)
        better = first | (merit_trial <= (1 - 1e-4 * fraction) * merit)
        settled = left <= TOLERANCE * eps * scale
        rounding = FLOOR * eps * torch.maximum(scale, length(q))
        stalled = ~better & (length(delta) <= rounding)  # not a wrong direction
        hopeless = first & ~torch.isfinite(merit_trial + left)  # there is no direction to follow
        accept = ~done & (better | settled)
        new = ((trial, x), (delta_trial, delta), (merit_trial, merit))
        new = (*new, *zip(values_trial, values, strict=True))
        x, delta, merit, *values = (torch.where(_like(accept, a), a, b) for a, b in new)
        fraction = torch.where(accept, 1.0, fraction / 2)
        return count + 1, done | settled | stalled | hopeless, x, delta, merit, fraction, scale.clone(), *values

    def forward(self, problem: Values, guess: Tensor, constants: Values, slopes: bool = False) -> Values:
        """Iterate to the end: Δ, delta, merit, done, p1, L, c, …."""
        carry: Any = self.start(problem[0], problem[2], guess, slopes)
        ends = len(carry), len(carry) + len(problem)

        def turn(*x: Tensor) -> Values:
            return self.iterate(x[ends[0] : ends[1]], x[: ends[0]], x[ends[1] :])

        # The operator itself: its wrapper would first have dynamo trace the loop, which takes longer than all else.
        ended = while_loop_op(lambda *x: self.unfinished(x[0], x[1]), turn, carry, (*problem, *constants))
        _, done, x, delta, merit, _, _, *values = ended
        return x, delta, merit, done, *values


def status_of(h: Tensor, merit: Tensor, residual: Tensor, done: Tensor, L: Tensor, c: Tensor) -> Tensor:
    """The status of each sample by the rules of the eager solver, uint8; 5, as in C, where h is no step."""
    status = torch.where(done, CONVERGED, MAX_ITERATIONS)
    status = torch.where(torch.isfinite(residual) & (c != 0), status, SINGULAR)
    status = torch.where(torch.isfinite(merit) & torch.isfinite(L), status, DIVERGED)
    return torch.where((h > 0) & torch.isfinite(h), status, BAD_INPUT).to(torch.uint8)


class StepModule(nn.Module):
    """(q, p, s, h[, u]) → (q1, p1, s1, c, residual, status[, outside]), differentiable in the state.

    The solve is outside autograd; its derivative is that of the implicit-function theorem, dΔ = −J⁻¹ dF, with J,
    ∂p1/∂q1 and ∂c/∂q1 from the last accepted iteration.

    Parameters
    ----------
    model
        The discrete Lagrangian, copied; or its equations.
    iterations
        Bound on the Newton iterations, at least 2.
    box
        Adds the output `outside`, uint8: 1 where the step starts or ends outside.
    """

    def __init__(
        self,
        model: ContactLagrangian | Equations,
        iterations: int = ITERATIONS,
        box: Mapping[str, Sequence[float]] | None = None,
    ):
        super().__init__()
        if iterations < 2:
            raise InputError(f"newton_iterations must be at least 2, got {iterations}; {ITERATIONS} suits most models")
        equations = Equations.of(model)
        self.newton = Newton(equations.slopes, iterations)
        self.first_order = equations.first_order
        self.box = Box.of(box, equations.model)

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
        problem = tuple(x.detach() for x in (q, p, s, h, *u))
        constants = self.newton.equation.constants
        delta, step, merit, done, _, L, c, J, p1_q1, c_q1 = self.newton(
            problem, torch.zeros_like(problem[0]), constants, slopes=True
        )
        residual = length(step)
        status = status_of(h, merit, residual, done, L, c)
        F, p1, L, c, D2 = self.first_order(q, p, s, h, delta, *u)
        nan = torch.where(status == CONVERGED, 0.0, torch.nan).to(q.dtype)
        move = -eliminate(J, (F - F.detach())[..., None])[..., 0]  # zero in value
        p1 = p1 + (p1_q1 * move[..., None, :]).sum(-1)
        L, c = L + (D2 * move).sum(-1), c + (c_q1 * move).sum(-1)
        new = (q + delta + move + nan[..., None], p1 + nan[..., None], s + L + nan)
        return *new, c + nan, residual, status, *outside(self.box, (q, p, s), new)


class Track(nn.Module):
    """What a rollout carries from step to step.

    A count, the state, what rounding took from q and s (Kahan's sum, without which float32 loses a digit every ten
    steps), and the last three mean velocities Δ/h.
    """

    def start(self, q: Tensor, p: Tensor, s: Tensor) -> Values:
        """The carry before the first step."""
        zero = torch.zeros_like(q)
        known = torch.zeros((), dtype=torch.int64, device=q.device)
        return known, dense(q), dense(p), dense(s), *(zero.clone() for _ in range(4)), torch.zeros_like(s)

    def guess(self, carry: Values, h: Tensor) -> Tensor:
        """Δ by the cubic through the last four positions, where there are as many; exact weights for equal steps."""
        known, _, _, _, v0, v1, v2, _, _ = carry
        v = torch.where(known >= 3, 3 * (v0 - v1) + v2, torch.where(known == 2, 2 * v0 - v1, v0))
        return h[..., None] * v

    def advance(self, carry: Values, h: Tensor, solved: Values) -> tuple[Values, Values]:
        """The next carry, and what the step gives: q1, p1, s1, c, residual, status."""
        known, q, _, s, v0, v1, _, lost_q, lost_s = carry
        delta, step, merit, done, p1, L, c = solved
        residual = length(step)
        status = status_of(h, merit, residual, done, L, c)
        nan = torch.where(status == CONVERGED, 0.0, torch.nan).to(q.dtype)
        more, gain = delta + lost_q, L + lost_s
        q1, p1, s1, c = q + more + nan[..., None], p1 + nan[..., None], s + gain + nan, c + nan
        velocities = (delta / h[..., None], v0.clone(), v1.clone())
        new = (known + 1, q1, p1, s1, *velocities, more - (q1 - q), gain - (s1 - s))
        return new, (q1.clone(), p1.clone(), s1.clone(), c, residual, status)


class Box(nn.Module):
    """Where the model was fitted; angles count modulo 2π."""

    low: Tensor  # (2n + 1)
    high: Tensor
    turn: Tensor  # 2π for an angle, else 0
    inverse: Tensor  # 1/2π for an angle, else 0

    def __init__(self, box: Mapping[str, Sequence[float]], angles: Sequence[bool], dtype: torch.dtype):
        super().__init__()
        low = torch.tensor([*box["q_low"], *box["p_low"], *box["s_low"]], dtype=torch.float64)
        high = torch.tensor([*box["q_high"], *box["p_high"], *box["s_high"]], dtype=torch.float64)
        turn = torch.zeros_like(low)
        turn[: len(angles)] = torch.tensor([2 * math.pi * bool(a) for a in angles], dtype=torch.float64)
        inverse = torch.where(turn > 0, 1 / turn, 0.0)
        for name, x in (("low", low), ("high", high), ("turn", turn), ("inverse", inverse)):
            self.register_buffer(name, x.to(dtype))

    @classmethod
    def of(cls, box: Mapping[str, Sequence[float]] | None, model: ContactLagrangian) -> Box | None:
        """The box of a model, if there is one."""
        return None if box is None else cls(box, model.config.angles, next(model.parameters()).dtype)

    @property
    def bounds(self) -> Values:
        """What a loop takes as operands."""
        return self.low, self.high, self.turn, self.inverse

    def forward(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """(...) True where a state lies outside, or is not a number."""
        return self.beyond((q, p, s), self.bounds)

    def beyond(self, state: Values, bounds: Sequence[Tensor]) -> Tensor:
        """The same with the bounds given."""
        q, p, s = state
        low, high, turn, inverse = bounds
        x = torch.cat([q, p, s[..., None]], -1)
        x = x - turn * torch.round((x - (low + high) / 2) * inverse)
        return ~((x >= low) & (x <= high)).all(-1)


class RolloutModule(nn.Module):
    """(q, p, s, h[, u]) → K steps, h of shape (K, B): both loops are inside the graph.

    Parameters
    ----------
    model
        The discrete Lagrangian, copied; or its equations.
    iterations
        Bound on the Newton iterations of a step.
    box
        Adds the output `outside`, uint8: 1 where a step starts or ends outside.
    """

    def __init__(
        self,
        model: ContactLagrangian | Equations,
        iterations: int = ITERATIONS,
        box: Mapping[str, Sequence[float]] | None = None,
    ):
        super().__init__()
        equations = Equations.of(model)
        self.newton = Newton(equations.newton, iterations)
        self.track = Track()
        self.box = Box.of(box, equations.model)

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
        carry = self.track.start(q, p, s)
        bounds = () if self.box is None else self.box.bounds
        ends = len(carry), len(carry) + 1 + len(u)

        def step(*x: Any) -> list[Tensor]:
            carry, (h, *u), (size, *fixed) = x[: ends[0]], x[ends[0] : ends[1]], x[ends[1] :]
            # The sum keeps the batch size a symbol of this graph, which inductor needs to allocate the outputs.
            h = h + torch.zeros(size, dtype=h.dtype, device=h.device)
            state = carry[1:4]
            constants = tuple(fixed[len(bounds) :])
            solved = self.newton((*state, h, *u), self.track.guess(carry, h), constants)
            carry, out = self.track.advance(carry, h, solved)
            return [*carry, *out, *outside(self.box, state, out[:3], fixed[: len(bounds)])]

        found = scan_op(step, list(carry), [h, *u], (s.shape[0], *bounds, *self.newton.equation.constants))
        return tuple(found[len(carry) :])


class InitModule(nn.Module):
    """(q0, q1, s0, h[, u]) → (p1, s1) = (D2 L_d, s0 + L_d): the state from two positions, differentiable."""

    def __init__(self, model: ContactLagrangian | Equations):
        super().__init__()
        self.first_order = Equations.of(model).first_order

    def forward(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, *u: Tensor) -> tuple[Tensor, Tensor]:
        """p1 (B, n) and s1 (B,)."""
        _, p1, L, _, _ = self.first_order(q0, torch.zeros_like(q0), s0, h, q1 - q0, *u)
        return p1, s0 + L


def outside(box: Box | None, before: Values, after: Values, bounds: Sequence[Tensor] | None = None) -> Values:
    """(outside,) where there is a box: 1 where the step starts or ends outside."""
    if box is None:
        return ()
    bounds = box.bounds if bounds is None else bounds
    return ((box.beyond(before, bounds) | box.beyond(after, bounds)).to(torch.uint8),)


def _like(mask: Tensor, x: Tensor) -> Tensor:
    return mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim))
