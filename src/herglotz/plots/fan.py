"""Fans of solutions, from many states or through one point, for the figures of `hamilton_jacobi.py`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics import DiscreteLagrangian
from herglotz.models import ContactLagrangian
from herglotz.plots.motion import momentum_unit
from herglotz.stepping import State, Stepper
from herglotz.theory import GeneratingFunction, generating_functions
from herglotz.verify.subject import subject

# S^k is drawn where the spread of ∂q_k/∂p̂0 is above this part of the fan's median. At a caustic the spread is 0, and
# S^k has no derivative.
MIN_SPREAD = 1e-3


@dataclass(frozen=True)
class Fan:
    """Initial states, a step size and the L_d that moves the states."""

    L_d: DiscreteLagrangian
    start: State  # (F, n), (F, n), (F,)
    h: float
    momentum_unit: str = ""

    def generating_functions(self, steps: int, start: State | None = None) -> list[GeneratingFunction]:
        """Return S^1, S^2, …, S^steps and their derivatives along every solution of the fan."""
        stepper = Stepper(self.L_d)

        def flow(*state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            return stepper.step(State(*state), self.h).state

        return generating_functions([flow] * steps, *(self.start if start is None else start))


def regular(S: GeneratingFunction) -> Tensor:
    """Return (F,) bool, where S^k exists: S^k is finite, and the solution is not at a caustic."""
    finite = torch.isfinite(S.S) & torch.isfinite(S.D2).all(-1) & torch.isfinite(S.p).all(-1)
    spread = torch.where(finite, S.spread, torch.zeros_like(S.spread))
    typical = spread[finite].median() if bool(finite.any()) else spread.sum()
    return finite & (spread > MIN_SPREAD * typical)


def spread_fan(source: Any, size: int, h: float | None = None) -> Fan:
    """Return `size` solutions from states spread over the data of a run; without a run, from drawn states."""
    if not _is_run(source):
        known = subject(source, _typical_step(source) if h is None else h, size, 0)
        if known.L_d is None:
            raise InputError(f"{known.name} holds no L_d; the figures of S^k need one: give the run, or the L_d")
        return Fan(known.L_d, known.states, known.h)
    states = source.states
    rows = torch.linspace(0, len(states.s) - 1, min(size, len(states.s))).round().long()
    start = _sound(State(*(x[rows] for x in states)))
    return Fan(source.model, start, source.h if h is None else h, momentum_unit(source))


def point_fan(source: Any, size: int, h: float | None = None) -> Fan:
    """Return `size` solutions through one point (q̂0, ŝ0) with different p̂0 along one direction.

    The point is a state of the run's data, or of the states that `spread_fan` starts from.
    """
    if _is_run(source):
        whole = Fan(source.model, source.states, source.h if h is None else h, momentum_unit(source))
    else:
        whole = spread_fan(source, 64, h)
    q, p, s = _sound(whole.start)
    row = int((q - q.median(0).values).abs().sum(-1).argmax()) if len(s) < 3 else len(s) // 3
    reach = (p - p.median(0).values).abs().quantile(0.9, dim=0)
    steps = torch.linspace(-1.0, 1.0, size, dtype=p.dtype, device=p.device)
    momenta = p.median(0).values + steps[:, None] * reach.clamp_min(1e-6)
    start = State(q[row].expand(size, -1).clone(), momenta, s[row].expand(size).clone())
    return replace(whole, start=start)


def _sound(states: State) -> State:
    """The finite states; raise if there are none."""
    finite = states.finite
    if not bool(finite.any()):
        raise InputError("the run has no finite state to start from; fit it again")
    return State(*(x[finite].detach() for x in states))


def _is_run(source: Any) -> bool:
    """True if the source holds a model and states that were fitted to data."""
    return hasattr(source, "states") and hasattr(source, "model")


def _typical_step(source: Any) -> float | None:
    """A tenth of the typical time of a model; None for other sources, which have a step of their own."""
    if not isinstance(source, ContactLagrangian):
        return None
    return 0.1 * min(a / b for a, b in zip(source.config.scale, source.config.speed, strict=True))
