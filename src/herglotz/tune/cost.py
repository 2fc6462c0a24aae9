"""Wall time of a step, one motion at a time; settings take turns, so that a slow minute slows all settings.

Only steps inside the horizon are timed: a damped motion comes to rest, and a step at rest costs next to nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import Any

import torch

from herglotz.stepping import State

# A timing takes enough steps that the call around the steps is small beside them. Eager: steps of each motion, and
# motions. C: motions, and least number of steps of all motions together.
EAGER_STEPS, EAGER_STARTS = 48, 2
C_STARTS, C_STEPS = 16, 4096


@dataclass(frozen=True)
class Cost:
    """Microseconds a step: the best round, and how far the median round lies above it."""

    step_us: float
    spread_us: float


@dataclass(frozen=True)
class Timed:
    """A call that takes `steps` steps, and, where its overhead counts, the same call without a step."""

    run: Callable[[], object]
    steps: int
    idle: Callable[[], object] | None = None


def measure_costs(timed: Sequence[Timed], rounds: int) -> list[Cost]:
    """Time every entry `rounds` times, in turn, after one untimed round; the least idle time is subtracted."""
    times = torch.zeros(2, len(timed), rounds, dtype=torch.float64)
    for k in range(-1, rounds):
        for i, entry in enumerate(timed):
            times[0, i, max(k, 0)] = _seconds(entry.run)
            times[1, i, max(k, 0)] = 0.0 if entry.idle is None else _seconds(entry.idle)
    steps = torch.tensor([entry.steps for entry in timed], dtype=torch.float64)
    best, middle = times[0].amin(1), times[0].median(1).values
    # On a busy machine an idle call may take longer than the run.
    idle = torch.minimum(times[1].amin(1), best / 2)
    costs = 1e6 * torch.stack([best - idle, middle - best]) / steps
    return [Cost(float(a), float(b)) for a, b in costs.T]


def timed_stepping(stepper: Any, starts: State, h: float, steps: int) -> Timed:
    """Return rollouts of `steps` steps, one start after the other; for C the overhead of the call is timed too."""
    library = getattr(stepper, "loop", stepper)
    if not hasattr(library, "prepared"):
        steps, singles = min(steps, EAGER_STEPS), _singles(starts, EAGER_STARTS, starts.q.dtype)
        calls = [partial(stepper.rollout, *start, h=h, steps=steps) for start in singles]
        return Timed(partial(_run, calls), len(calls) * steps)
    singles = _singles(starts, C_STARTS, library.dtype)
    repeats = max(1, C_STEPS // (len(singles) * steps))
    h_one = torch.full((1, 1), h, dtype=library.dtype)

    def calls_of(count: int) -> Callable[[], None]:
        # Arguments are made beforehand: checks in Python would take longer than the steps.
        return partial(_run, [library.prepared(*start, h_one.expand(1, count))[0] for start in singles] * repeats)

    return Timed(calls_of(steps), len(singles) * steps * repeats, calls_of(0))


def _singles(starts: State, count: int, dtype: torch.dtype) -> list[State]:
    """The first starts, at most `count`, each as a batch of one motion."""
    return [State(*(x[i : i + 1].to(dtype) for x in starts)) for i in range(min(count, len(starts.s)))]


@torch.no_grad()
def _run(calls: Sequence[Callable[[], object]]) -> None:
    for call in calls:
        call()


def _seconds(call: Callable[[], object]) -> float:
    started = perf_counter()
    call()
    return perf_counter() - started
