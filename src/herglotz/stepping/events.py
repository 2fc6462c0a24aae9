"""Events: where a function g(q, p, s) of the state changes sign within a step.

A stepper takes steps of any size, so the time of an event is a root of τ ↦ g(step from x_k by τ) on (0, h): the state
at the event is a state of the stepper, not an interpolation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from herglotz.errors import InputError, refuse
from herglotz.mechanics.newton import select
from herglotz.stepping.state import Crossings, State, Status, Step

# Every eighth trial is a bisection, so the trials halve the bracket at least ten times.
MAX_TRIALS = 80


@dataclass(frozen=True)
class Event:
    """A sign change of g along a trajectory; a zero at the very start does not count.

    Parameters
    ----------
    g
        Function of a `State`, one value per sample, (...).
    terminal
        Stop the sample there (`Status.STOPPED`); otherwise record the crossing and go on.
    direction
        +1: only where g rises through zero, −1: only where it falls, 0: both.
    """

    g: Callable[[State], Tensor]
    terminal: bool = True
    direction: int = 0

    def __post_init__(self):
        if self.direction not in (-1, 0, 1):
            raise InputError(f"direction must be -1, 0 or 1, got {self.direction}")


# (τ (...), guess (..., n)) → the step by τ from the present state
StepBy = Callable[[Tensor, Tensor], Step]


class Watch:
    """The events of a rollout: the samples that have stopped, and every crossing so far."""

    def __init__(self, events: Sequence[Event | Callable[[State], Tensor]], start: State):
        refuse({f"events must be a list of functions of a state, or of Event, got a {type(events).__name__}; write "
                "events=[...]": not isinstance(events, Sequence)})  # fmt: skip
        self.events = [e if isinstance(e, Event) else Event(e) for e in events]
        self.values = [self._value(e, start) for e in self.events]
        self.stopped = torch.zeros_like(start.s, dtype=torch.bool)
        self.t = torch.zeros_like(start.s)
        self.found: list[list[Crossings]] = [[] for _ in self.events]

    def hold(self, state: State) -> Step:
        """The step of a batch in which every sample has stopped."""
        zero = torch.zeros_like(state.s)
        return Step(state, zero + 1, torch.full_like(zero, Status.STOPPED, dtype=torch.uint8), zero, 0)

    def after(self, k: int, old: State, step: Step, h: Tensor, step_by: StepBy) -> Step:
        """Step k after its events: a sample ends at its first terminal event."""
        if bool(self.stopped.any()):
            step = _select(self.stopped, self.hold(old), step)
        h = h.detach().expand(old.s.shape)
        values = [self._value(e, step.state) for e in self.events]
        crossed = [_crosses(e, a, b) & ~self.stopped for e, a, b in zip(self.events, self.values, values, strict=True)]
        first = torch.full_like(self.t, torch.inf)
        if any(bool(mask.any()) for mask in crossed):
            located = [
                self._locate(e, ends, mask, (old, step), h, step_by)
                for e, *ends, mask in zip(self.events, self.values, values, crossed, strict=True)
            ]
            for event, (tau, _) in zip(self.events, located, strict=True):
                first = torch.minimum(first, tau) if event.terminal else first
            for found, (tau, at), mask in zip(self.found, located, crossed, strict=True):
                here = mask & (tau <= first)
                if bool(here.any()):
                    found.append(self._record(k, here, self.t + tau, at.state))
                stops = here & (tau == first)
                ended = torch.where(at.status == Status.CONVERGED, int(Status.STOPPED), at.status.int())
                stop = replace(at, status=ended.to(torch.uint8))
                step = _select(stops, stop, step)
        self.t = self.t + torch.where(self.stopped, 0.0, torch.minimum(first, h))
        self.stopped = self.stopped | torch.isfinite(first)
        self.values = values
        return step

    def crossings(self, like: State) -> tuple[Crossings, ...]:
        """All crossings, event by event; `like` is a state of the right shapes."""
        nothing = self._record(0, torch.zeros_like(self.stopped), self.t, like)
        return tuple(_joined([*found, nothing]) for found in self.found)

    def _value(self, event: Event, state: State) -> Tensor:
        with torch.no_grad():
            value = torch.as_tensor(event.g(state))
        if value.shape != state.s.shape:
            shape, expected = tuple(value.shape), tuple(state.s.shape)
            raise InputError(f"an event must give one value per sample, shape {expected}; got {shape}")
        return value.to(state.s)

    def _locate(
        self, event: Event, ends: list[Tensor], mask: Tensor, known: tuple[State, Step], h: Tensor, step_by: StepBy
    ) -> tuple[Tensor, Step]:
        """The time τ of a crossing, inf without one, and the step by τ; `ends` are g before and after `known`."""
        (g0, g1), (old, step) = ends, known
        if not bool(mask.any()):
            return torch.full_like(h, torch.inf), step
        q0, q1 = old.q.detach(), torch.where(mask[..., None], step.state.q.detach(), old.q.detach())

        def by(tau: Tensor) -> Step:
            return step_by(tau, q0 + (tau / h)[..., None] * (q1 - q0))

        with torch.no_grad():
            tau = _root(lambda tau: self._value(event, by(tau).state), g0, g1, h, mask)
        return torch.where(mask, tau, torch.inf), by(tau)

    def _record(self, k: int, mask: Tensor, t: Tensor, state: State) -> Crossings:
        index = mask.nonzero()
        step = torch.full((len(index),), k, device=index.device)
        return Crossings(index, step, t[mask], State(*(x[mask] for x in state)))


def _joined(found: list[Crossings]) -> Crossings:
    sample, step, t = (torch.cat([getattr(x, name) for x in found]) for name in ("sample", "step", "t"))
    return Crossings(sample, step, t, State(*map(torch.cat, zip(*(x.state for x in found), strict=True))))


def _crosses(event: Event, g0: Tensor, g1: Tensor) -> Tensor:
    rises, falls = (g0 < 0) & (g1 >= 0), (g0 > 0) & (g1 <= 0)
    return (rises & (event.direction >= 0)) | (falls & (event.direction <= 0))


def _root(g: Callable[[Tensor], Tensor], g0: Tensor, g1: Tensor, h: Tensor, mask: Tensor) -> Tensor:
    """τ in (0, h] with g(τ) = 0, by false position (Illinois) and bisection; g0 and g1 have opposite signs."""
    a, fa, b, fb = torch.zeros_like(h), g0, h, g1
    # The end that moved last: −1 left, +1 right.
    side = torch.zeros_like(h)
    width = 2 * torch.finfo(h.dtype).eps * h
    tau, done = b, ~mask | (fb == 0)
    for trial in range(MAX_TRIALS):
        if bool(done.all()):
            break
        guess = b - fb * (b - a) / (fb - fa)
        guess = torch.where((guess > a) & (guess < b) & (trial % 8 != 7), guess, (a + b) / 2)
        value = g(torch.where(done, tau, guess))
        left = torch.sign(value) == torch.sign(fa)
        # Illinois: the value of an end that stays twice is halved, which draws the next guess towards that end.
        fa, fb = (
            torch.where(left, value, torch.where(side > 0, fa / 2, fa)),
            torch.where(left, torch.where(side < 0, fb / 2, fb), value),
        )
        a, b, side = torch.where(left, guess, a), torch.where(left, b, guess), torch.where(left, -1.0, 1.0)
        settled = ((guess - tau).abs() <= width) | (value == 0) | (b - a <= width)
        tau, done = torch.where(done, tau, guess), done | settled
    return tau


def _select(mask: Tensor, a: Step, b: Step) -> Step:
    """The step `a` in the samples of `mask`, `b` in the others."""
    state = State(*select(mask, tuple(a.state), tuple(b.state)))
    c, status, residual = select(mask, (a.c, a.status, a.residual), (b.c, b.status, b.residual))
    return Step(state, c, status, residual, max(a.iterations, b.iterations))
