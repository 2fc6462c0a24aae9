"""Wall time of a step, one motion at a time; all settings take turns, so that a slow minute hits them alike.

Only steps inside the horizon are timed: a damped motion comes to rest, and a step at rest costs next to nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import torch

from herglotz.export.c_stepper import CLibrary
from herglotz.stepping import State
from herglotz.tune.kick_header import CompiledKicks

# One timing takes enough steps that the call around them is small beside them.
EAGER_STEPS, EAGER_STARTS = 48, 2  # steps of each motion, and motions
C_STARTS, C_STEPS = 16, 4096  # motions, and least number of steps of all motions together


@dataclass(frozen=True)
class Cost:
    """Microseconds a step: the best round, and how far the median round lies above it."""

    step_us: float
    spread_us: float


@dataclass(frozen=True)
class Timed:
    """A call that takes `steps` steps, and, where its overhead counts, the same call without a step."""

    run: Callable[[], None]
    steps: int
    idle: Callable[[], None] | None = None


def measure_costs(timed: Sequence[Timed], rounds: int) -> list[Cost]:
    """Time every entry `rounds` times, in turn, after one untimed round; the least idle time is subtracted."""
    times = torch.zeros(2, len(timed), rounds, dtype=torch.float64)
    for k in range(-1, rounds):
        for i, one in enumerate(timed):
            times[0, i, max(k, 0)] = _seconds(one.run)
            times[1, i, max(k, 0)] = 0.0 if one.idle is None else _seconds(one.idle)
    steps = torch.tensor([one.steps for one in timed], dtype=torch.float64)
    best, middle = times[0].amin(1), times[0].median(1).values
    idle = torch.minimum(times[1].amin(1), best / 2)  # on a busy machine an idle call may take longer than the run
    costs = 1e6 * torch.stack([best - idle, middle - best]) / steps
    return [Cost(float(a), float(b)) for a, b in costs.T]


def timed_stepping(stepper: Any, starts: State, h: float, steps: int) -> Timed:
    """Return rollouts of `steps` steps, one start after the other; for C the overhead of the call is timed too."""
    if isinstance(getattr(stepper, "loop", stepper), CLibrary | CompiledKicks):
        few = State(*(x[:C_STARTS] for x in starts))
        count = len(few.s)
        repeats = max(1, C_STEPS // (count * steps))
        run, idle = (_repeated(_native(stepper, few, h, k), repeats) for k in (steps, 0))
        return Timed(run, count * steps * repeats, idle)
    steps, count = min(steps, EAGER_STEPS), min(EAGER_STARTS, len(starts.s))
    single = [State(*(x[i : i + 1] for x in starts)) for i in range(count)]

    def run() -> None:
        with torch.no_grad():
            for start in single:
                stepper.rollout(*start, h=h, steps=steps)

    return Timed(run, count * steps)


def _repeated(calls: list[Callable[[], None]], times: int) -> Callable[[], None]:
    def run() -> None:
        for _ in range(times):
            for call in calls:
                call()

    return run


def _native(stepper: Any, few: State, h: float, steps: int) -> list[Callable[[], None]]:
    """Return calls of the C loop with arguments made beforehand: checks in Python would take longer than the steps."""
    library: CLibrary | CompiledKicks = getattr(stepper, "loop", stepper)
    singles = [State(*(x[i : i + 1].to(library.dtype) for x in few)) for i in range(len(few.s))]
    if isinstance(library, CompiledKicks):
        return [library.prepared(start, steps)[0] for start in singles]
    h_all = torch.full((1, 1), h, dtype=library.dtype).expand(1, steps)
    return [library.prepared(*start, h=h_all)[0] for start in singles]


def _seconds(run: Callable[[], None]) -> float:
    started = perf_counter()
    run()
    return perf_counter() - started
