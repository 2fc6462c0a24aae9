"""Rollouts of any stepper: inputs, decimation, events, and memory that does not grow with the number of steps.

A rollout is a chain of segments. A segment steps `Carry` to `Carry` and returns a block of kept entries. Without
gradients a block is written into buffers made beforehand; with `checkpoint` a segment saves its start only, and the
backward pass runs the segment again.
"""

from __future__ import annotations

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as save_start_only

from herglotz.errors import InputError, check_whole
from herglotz.mechanics.partials import ABSENT
from herglotz.progress import ProgressBar
from herglotz.stepping.events import Event, Watch
from herglotz.stepping.state import (
    Crossings,
    Rollout,
    State,
    Status,
    Step,
    StepError,
    action_of,
    check_h,
    check_spreads,
    check_state,
    rows_of,
    step_sizes,
    throw_failure,
)

# Number of positions: six take a third fewer evaluations than four (a cubic) at small h, and no more at large h.
LENGTH = 6
# Weights of polynomials through 1 … LENGTH equally spaced positions: binomials with alternating signs.
EQUAL = {n: tuple((-1.0) ** (n - 1 - i) * comb(n, i) for i in range(n)) for n in range(1, LENGTH + 1)}


def extrapolation_weights(h: Tensor, count: int) -> Tensor:
    """Lagrange weights (..., count) of `count` positions for the next position; h (..., count) are the steps."""
    t = torch.cat([torch.zeros_like(h[..., :1]), h.cumsum(-1)], -1)
    t, target = t[..., :-1] - t[..., -2:-1], h[..., -1]
    weights = []
    for i in range(count):
        weight = torch.ones_like(target)
        for j in range(count):
            if j != i:
                weight = weight * (target - t[..., j]) / (t[..., i] - t[..., j])
        weights.append(weight)
    return torch.stack(weights, -1)


class Extrapolation:
    """The guesses of a rollout; the weights of equal steps are constants, other weights are computed once."""

    def __init__(self, h: Tensor):
        # A scalar h, expanded.
        self.equal = h.stride(-1) == 0 or h.shape[-1] == 1
        self.h = h.detach()
        self._weights: dict[int, Tensor] = {}

    def __call__(self, trail: tuple[Tensor, ...], k: int) -> Tensor:
        """The guess for the end of step k from the positions (..., n) that led to its start, at most `LENGTH`."""
        count = len(trail)
        if self.equal:
            weights = EQUAL[count]
            guess = weights[-1] * trail[-1]
            for weight, q in zip(weights[:-1], trail, strict=False):
                guess = torch.add(guess, q, alpha=weight)
            return guess
        if count not in self._weights:
            self._weights[count] = extrapolation_weights(self.h.unfold(-1, count, 1), count)
        weights = self._weights[count][..., k - count + 1, :]
        return (torch.stack(trail, -1) * weights[..., None, :]).sum(-1)


# Seconds of a rollout before a progress bar appears: a shorter wait needs none.
PROGRESS_AFTER = 2.0


class Carry(NamedTuple):
    """The data that a step hands to the next step.

    `state` is a `State`, or another named tuple of tensors with the position first; `trail` has the last positions, for
    the guess; `low` is the rounding that the state has lost so far (compensated sums), if increments are known.
    """

    state: Any
    trail: tuple[Tensor, ...]
    sigma: Tensor  # (...)
    low: Any


# The kept entries of N steps: the parts of the state, σ, status and residual, (N, ..., *) each. Time is first, so that
# the entries of a step are contiguous in a buffer.
Block = tuple[Tensor, ...]


class Track(NamedTuple):
    """All entries that a rollout keeps; time is the first axis after the batch's axes."""

    states: tuple[Tensor, ...]  # (..., K+1, *) each
    sigma: Tensor  # (..., K+1)
    status: Tensor  # (..., K)
    residual: Tensor  # (..., K)
    events: tuple[Crossings, ...] = ()
    outside: Tensor | None = None  # (..., K), of an exported file


# (state, h, guess, u, low) → the step and its `low`; a guess of None is the step's own.
OneStep = Callable[[Any, Tensor, Tensor | None, Tensor | None, Any], tuple[Step, Any]]
# (step, state, h, u) → nothing, or `StepError`
Check = Callable[[Step, Any, Tensor, Tensor | None], None]


@dataclass(frozen=True)
class Plan:
    """How a rollout is cut up."""

    steps: int
    every: int = 1
    chunk: int = 1024
    checkpoint: int | None = None

    def __post_init__(self):
        segment = {} if self.checkpoint is None else {"checkpoint": self.checkpoint}
        check_whole(1, every=self.every, chunk=self.chunk, **segment)
        if self.steps % self.every:
            raise InputError(f"every={self.every} does not divide the number of steps {self.steps}")

    @property
    def segments(self) -> Iterator[range]:
        """Runs of steps, each a multiple of `every` long."""
        wanted = self.chunk if self.checkpoint is None else self.checkpoint
        length = -(-wanted // self.every) * self.every
        return (range(k, min(k + length, self.steps)) for k in range(0, self.steps, length))


@dataclass(frozen=True)
class Drive:
    """The arguments of a rollout.

    `single_step` makes the function that takes a step; a segment calls it once, so that its steps may share work.
    `extrapolate` says whether the steps want a guess.
    """

    single_step: Callable[[], OneStep]
    h: Tensor  # (..., K) all steps
    plan: Plan
    inputs: Tensor | None = None  # (..., K, m)
    watch: Watch | None = None
    extrapolate: bool = True
    check: Check | None = None

    @cached_property
    def guess(self) -> Extrapolation:
        """Where iterations start."""
        return Extrapolation(self.h)

    @cached_property
    def equal(self) -> Tensor | None:
        """The step, if all steps are equal: the same tensor each time, so that functions of h alone are kept."""
        return self.h[..., 0] if self.h.stride(-1) == 0 else None

    def take(self, single: OneStep, k: int, carry: Carry) -> tuple[Step, Any]:
        """Step k after its events."""
        state, low = carry.state, carry.low
        h = self.h[..., k] if self.equal is None else self.equal
        u = None if self.inputs is None else self.inputs[..., k, :]
        guess = self.guess(carry.trail, k) if self.extrapolate and len(carry.trail) > 1 else None
        try:
            step, new_low = single(state, h, guess, u, low)
            if self.watch is not None:
                step = self.watch.after(k, state, step, h, lambda tau, guess: single(state, tau, guess, u, low)[0])
            if self.check is not None:
                self.check(step, state, h, u)
        except StepError as error:
            raise StepError(f"step {k}: {error}") from None
        return step, new_low


def roll_out(start: Any, drive: Drive) -> Track:
    """Step from `start`, a named tuple of tensors, through the whole plan."""
    plan, progress = drive.plan, None
    if sys.stderr.isatty():
        progress = ProgressBar(total=plan.steps, delay=PROGRESS_AFTER, unit="step", leave=False)
    carry = Carry(start, (start[0].detach(),), torch.ones_like(start[-1]), None)
    graph = torch.is_grad_enabled()
    blocks: list[Block] = []
    for ks in plan.segments:
        if graph and plan.checkpoint is not None:
            carry, block = save_start_only(_segment, carry, ks, drive, use_reentrant=False, preserve_rng_state=False)
        else:
            carry, block = _segment(carry, ks, drive, progress)
        if graph or len(ks) == plan.steps:
            blocks.append(block)
        else:
            blocks = blocks or [_buffers(block, plan.steps // plan.every)]
            _write(blocks[0], block, ks.start // plan.every)
    if progress is not None:
        progress.close()
    whole = blocks[0] if len(blocks) == 1 else map(torch.cat, zip(*blocks, strict=True))
    # Time moves behind the axes of the batch.
    *states, sigma, status, residual = (x.movedim(0, carry.sigma.ndim) for x in whole)
    events = () if drive.watch is None else drive.watch.crossings(carry.state)
    return without_lost_factors(Track(tuple(states), sigma, status, residual, events))


def without_lost_factors(track: Track) -> Track:
    """Steps behind an overflow of σ = ∏ c_j are lost: their states are NaN, with a status, as in C."""
    if bool(torch.isfinite(track.sigma[..., -1]).all()):
        return track
    lost = ~torch.isfinite(track.sigma) & (torch.arange(track.sigma.shape[-1]) > 0).to(track.sigma.device)
    nan = torch.where(lost, torch.nan, 0.0).to(track.sigma.dtype)
    states = tuple(x + nan.reshape(nan.shape + (1,) * (x.ndim - nan.ndim)) for x in track.states)
    found = torch.where(lost[..., 1:] & (track.status == 0), int(Status.DIVERGED), track.status).to(torch.uint8)
    return track._replace(states=states, sigma=track.sigma + nan, status=found)


def _segment(carry: Carry, ks: range, drive: Drive, progress: ProgressBar | None = None) -> tuple[Carry, Block]:
    """Take the steps `ks`."""
    single, every, watch = drive.single_step(), drive.plan.every, drive.watch
    kept = [] if ks.start else [(*carry.state, carry.sigma)]
    results: list[tuple[Tensor, Tensor]] = []
    for k in ks:
        state, trail, sigma, low = carry
        if watch is not None and bool(watch.stopped.all()):
            step = watch.hold(state)
        else:
            step, low = drive.take(single, k, carry)
        state, sigma = step.state, sigma * step.c
        position = state[0]
        trail = (*trail[1 - LENGTH :], position.detach() if position.requires_grad else position)
        carry = Carry(state, trail, sigma, low)
        if k % every and results:
            status, residual = results[-1]
            results[-1] = torch.maximum(status, step.status), torch.maximum(residual, step.residual)
        else:
            results.append((step.status, step.residual))
        if (k + 1) % every == 0:
            kept.append((*state, sigma))
        if progress is not None:
            progress.update()
    return carry, tuple(torch.stack(x) for entries in (kept, results) for x in zip(*entries, strict=True))


def _buffers(first: Block, entries: int) -> Block:
    """Room for a whole rollout; state and σ have the start in front, like those of the first block."""
    return tuple(x.new_empty(entries + len(x) - len(first[-1]), *x.shape[1:]) for x in first)


def _write(buffers: Block, block: Block, start: int) -> None:
    """Write the block of the steps from entry `start` on."""
    for buffer, values in zip(buffers, block, strict=True):
        offset = start + (start > 0 and len(buffer) > len(buffers[-1]))
        buffer[offset : offset + len(values)] = values


class OneStepMethod(ABC):
    """A stepper of states (q, p, s). A concrete stepper implements `step`; rollouts are the same for all steppers.

    With `throw` the first sample that fails raises `StepError`; `iterates` says whether steps want a guess.
    """

    throw: bool = False
    iterates: bool = False

    @abstractmethod
    def step(self, state: Any, h: Tensor | float, guess: Tensor | None = None) -> Step:
        """A step of h > 0, scalar or (...)."""

    def rollout(
        self,
        q: Tensor,
        p: Tensor = ABSENT,
        s: Tensor | None = None,
        *,
        h: Tensor | float,
        steps: int | None = None,
        inputs: Tensor | None = None,
        every: int = 1,
        events: Sequence[Event | Callable[[State], Tensor]] = (),
        checkpoint: int | None = None,
        chunk: int = 1024,
    ) -> Rollout:
        """Step K times from (q, p, s).

        Parameters
        ----------
        q, p
            (..., n).
        s
            (...); default 0.
        h
            A scalar for equal steps, (K,) for steps shared by the batch, or (..., K).
        steps
            K; needed for a scalar h without inputs only.
        inputs
            (K, m) or (..., K, m): u_k of each step, for an L_d with `at(u)`.
        every
            m: keep every m-th state only; m divides K. Statuses and residuals are the worst of the m steps.
        events
            `Event`s, or functions of the state; a sample stops where a function changes sign. A stopped sample keeps
            its state at the event, with `Status.STOPPED`. The time of an event is a constant for the gradient.
        checkpoint
            Length of the segments whose inner steps the backward pass computes again: K steps then need memory for
            about K / length + length steps. Without gradients `checkpoint` has no effect.
        chunk
            Number of steps that are gathered before writing into the result.

        Returns
        -------
        Rollout
            K/m + 1 states and K/m statuses.

        Raises
        ------
        InputError
            If h is not positive, lengths disagree, the L_d takes no inputs, or options do not fit together.
        """
        start = self._checked(State(q, p, action_of(s, q=q, p=p)))
        if inputs is not None:
            inputs = self._checked_inputs(rows_of(inputs), q)
            steps = inputs.shape[-2] if steps is None and torch.as_tensor(h).ndim == 0 else steps
        if events and checkpoint is not None:
            raise InputError("events and checkpoint exclude one another; leave one out")
        watch = Watch(events, start) if events else None
        track = self._roll_out(start, h, steps, inputs, watch, every=every, chunk=chunk, checkpoint=checkpoint)
        q, p, s = track.states
        return Rollout(q, p, s, track.sigma, track.status, track.residual, track.events, track.outside)

    def _roll_out(
        self,
        start: Any,
        h: Tensor | float,
        steps: int | None,
        inputs: Tensor | None = None,
        watch: Watch | None = None,
        **plan: Any,
    ) -> Track:
        """The rollout of a named tuple of tensors, the last of shape (...); exported files replace this loop."""
        h_all = step_sizes(check_h(h, start[-1]), steps)
        check_spreads(h_all[..., 0], start[-1])
        if inputs is not None and inputs.shape[-2] != h_all.shape[-1]:
            raise InputError(f"inputs list {inputs.shape[-2]} steps, but the rollout has {h_all.shape[-1]}")
        cut = Plan(h_all.shape[-1], **plan)
        return roll_out(start, Drive(self._single_step, h_all, cut, inputs, watch, self.iterates, self._check_step))

    def _checked(self, state: State) -> State:
        """The state, if this stepper can start from it."""
        return check_state(state)

    def _checked_inputs(self, inputs: Tensor, like: Tensor) -> Tensor:  # noqa: ARG002
        """The inputs (K, m) or (..., K, m) for positions `like`; raise InputError if the stepper takes no inputs."""
        raise InputError(f"{type(self).__name__} takes no inputs, got {tuple(inputs.shape)}; leave them out")

    def _single_step(self) -> OneStep:
        """The function that takes the steps of a rollout."""
        return lambda state, h, guess, u, low: (self.step(state, h, guess), None)  # noqa: ARG005  same signature for all

    def _check_step(self, step: Step, state: Any, h: Tensor, u: Tensor | None) -> None:  # noqa: ARG002
        """With `throw`, raise `StepError` if a sample failed."""
        if self.throw:
            throw_failure(step.status, step.residual)
