"""Many steps: inputs, decimation, events, and memory that does not grow with the number of steps.

A rollout is a chain of segments. A segment steps `Walk` to `Walk` and returns the block of states it keeps. Without
gradients a block is written into buffers made beforehand; with `checkpoint` a segment saves its start only and is run
again by the backward pass.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as save_start_only

from herglotz.errors import InputError
from herglotz.stepping.events import Watch
from herglotz.stepping.guess import LENGTH, Extrapolation
from herglotz.stepping.state import Rollout, State, Step

PROGRESS_AFTER = 2.0  # seconds


class Walk(NamedTuple):
    """What one step hands to the next."""

    state: State
    trail: tuple[Tensor, ...]  # the last positions, for the guess
    sigma: Tensor  # (...)
    low: State | None  # what rounding took from the state so far (compensated sums), where increments are known


class Block(NamedTuple):
    """The kept entries of a segment of steps, time first: a step then is one contiguous piece of a buffer."""

    q: Tensor  # (N, ..., n)
    p: Tensor  # (N, ..., n)
    s: Tensor  # (N, ...)
    sigma: Tensor  # (N, ...)
    status: Tensor  # (N, ...)
    residual: Tensor  # (N, ...)


Advance = Callable[[int, Walk, Tensor], tuple[Step, State | None]]  # (k, walk, guess) → the step and its `low`


@dataclass(frozen=True)
class Plan:
    """How a rollout is cut up."""

    steps: int
    every: int = 1
    chunk: int = 1024
    checkpoint: int | None = None

    def __post_init__(self):
        for name in ("every", "chunk", "checkpoint"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} must be >= 1, got {value}")
        if self.steps % self.every:
            raise InputError(f"every={self.every} does not divide the number of steps {self.steps}")

    @property
    def segments(self) -> Iterator[range]:
        """Runs of steps, each a multiple of `every` long."""
        wanted = self.chunk if self.checkpoint is None else self.checkpoint
        length = -(-wanted // self.every) * self.every
        return (range(k, min(k + length, self.steps)) for k in range(0, self.steps, length))


def roll_out(
    start: State,
    h: Tensor,
    advance: Callable[[], Advance],
    plan: Plan,
    watch: Watch | None,
    extrapolate: bool = True,
) -> Rollout:
    """Step from `start` through all of `plan`.

    Parameters
    ----------
    start
        The first state.
    h
        (..., K) all steps.
    advance
        Makes the function that takes one step; called once for each segment, which may keep what its steps share.
    plan
        Segments and decimation.
    watch
        The events to look for, or None.
    extrapolate
        Whether the steps iterate and want a good guess; without, it is the present position.
    """
    guess, progress = Extrapolation(h, extrapolate), _Progress(plan.steps)
    walk = Walk(start, (start.q.detach(),), torch.ones_like(start.s), None)
    graph = torch.is_grad_enabled()
    blocks: list[Block] = []
    for ks in plan.segments:
        if graph and plan.checkpoint is not None:
            walk, block = save_start_only(
                _segment, walk, ks, advance, guess, plan.every, use_reentrant=False, preserve_rng_state=False
            )
        else:
            walk, block = _segment(walk, ks, advance, guess, plan.every, watch, progress)
        if graph or len(ks) == plan.steps:
            blocks.append(block)
        else:
            blocks = blocks or [_buffers(block, plan.steps // plan.every)]
            _write(blocks[0], block, ks.start // plan.every)
    progress.close()
    joined = blocks[0] if len(blocks) == 1 else Block(*map(torch.cat, zip(*blocks, strict=True)))
    events = () if watch is None else watch.crossings(walk.state)
    q, p, s, sigma, status, residual = (x.movedim(0, -2 if i < 2 else -1) for i, x in enumerate(joined))
    return Rollout(q, p, s, sigma, status, residual, events)


def _segment(
    walk: Walk,
    ks: range,
    advance: Callable[[], Advance],
    guess: Extrapolation,
    every: int,
    watch: Watch | None = None,
    progress: _Progress | None = None,
) -> tuple[Walk, Block]:
    """Take the steps `ks`."""
    take = advance()
    kept = [walk] if ks.start == 0 else []
    results: list[tuple[Tensor, Tensor]] = []
    state, trail, sigma, low = walk
    for k in ks:
        if watch is not None and bool(watch.stopped.all()):
            step = watch.hold(state)
        else:
            step, low = take(k, Walk(state, trail, sigma, low), guess(trail, k))
        state, sigma = step.state, sigma * step.c
        trail = (*trail[1 - LENGTH :], state.q.detach() if state.q.requires_grad else state.q)
        if k % every and results:
            status, residual = results[-1]
            results[-1] = torch.maximum(status, step.status), torch.maximum(residual, step.residual)
        else:
            results.append((step.status, step.residual))
        if (k + 1) % every == 0:
            kept.append(Walk(state, (), sigma, None))
        if progress is not None:
            progress.update()
    states = [torch.stack(x) for x in zip(*((*w.state, w.sigma) for w in kept), strict=True)]
    outcome = [torch.stack(x) for x in zip(*results, strict=True)]
    return Walk(state, trail, sigma, low), Block(*states, *outcome)


def _buffers(block: Block, entries: int) -> Block:
    """Room for a whole rollout."""
    return Block(*(x.new_empty(entries + (i < 4), *x.shape[1:]) for i, x in enumerate(block)))


def _write(buffers: Block, block: Block, start: int) -> None:
    for i, (buffer, values) in enumerate(zip(buffers, block, strict=True)):
        offset = start + (i < 4 and start > 0)  # states have the start in front
        buffer[offset : offset + len(values)] = values


class _Progress:
    """A progress bar in a terminal for a rollout of more than two seconds."""

    def __init__(self, steps: int):
        self.steps, self.count, self.bar = steps, 0, None
        self.begin = perf_counter() if sys.stderr.isatty() else float("inf")

    def update(self) -> None:
        """Count one step."""
        self.count += 1
        if self.bar is not None:
            self.bar.update()
        elif perf_counter() - self.begin > PROGRESS_AFTER:
            from tqdm import tqdm

            self.bar = tqdm(total=self.steps, initial=self.count, unit="step", leave=False)

    def close(self) -> None:
        """Remove the bar."""
        if self.bar is not None:
            self.bar.close()
