"""Reference motions of a search: rollouts of the run's own model from starts inside its box."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import torch

from herglotz.data.splits import leading_rows
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper
from herglotz.training import Run

# Share of the box by which a start is moved away from a recorded state, at most.
JITTER = 0.05


@dataclass(frozen=True)
class Motions:
    """B motions of the run's own model at its own step `base`, in float64."""

    base: float
    states: State  # (B, K+1, n), (B, K+1, n), (B, K+1)

    def at(self, h: float) -> State:
        """Return the states a time h apart, a multiple of `base`."""
        return State(*(x[:, :: round(h / self.base)] for x in self.states))

    def steps(self, h: float) -> int:
        """Return how many steps of h a motion has."""
        return (self.states.s.shape[1] - 1) // round(h / self.base)

    def starts(self) -> State:
        """Return the states at time 0, (B, n), (B, n), (B,)."""
        return State(*(x[:, 0] for x in self.states))


def draw_starts(run: Run, count: int, seed: int) -> State:
    """Draw random recorded states of the run, each moved by up to `JITTER` of the box, and kept inside the box.

    A uniform draw would fill the corners of the box too, where the model has seen no data.
    """
    generator = torch.Generator().manual_seed(seed)
    rows = leading_rows(run.data.lengths, run.train_lengths)
    rows = rows[run.states.finite.cpu()[rows]]
    if not len(rows):
        raise InputError("the run has no finite state to start from; fit it again")
    rows = rows[torch.randint(len(rows), (count,), generator=generator)]
    moved = []
    for name, x in zip("qps", run.states, strict=True):
        low, high = (torch.tensor(run.box[f"{name}_{end}"], dtype=torch.float64) for end in ("low", "high"))
        x = x.detach().cpu().double()[rows].reshape(count, -1)
        kick = 2 * torch.rand(x.shape, generator=generator, dtype=torch.float64) - 1
        moved.append((x + JITTER * (high - low) * kick).clamp(low, high))
    return State(moved[0], moved[1], moved[2][:, 0])


def record(run: Run, starts: State, horizon: float) -> Motions:
    """Return motions over `horizon` from these starts; motions that fail are left out.

    The reference is the run's model at the run's own step: the error of this flow against the data has been measured.
    Raise InputError if more than half of the motions fail.
    """
    with torch.no_grad():
        out = Stepper(frozen_double(run)).rollout(*starts, h=run.h, steps=round(horizon / run.h))
    good = out.states.finite.all(1)
    if int(good.sum()) * 2 < len(good):
        raise InputError(
            f"the run's own stepper fails on {int((~good).sum())} of {len(good)} starts over {horizon:g}; "
            "take a shorter --horizon"
        )
    return Motions(run.h, State(out.q[good], out.p[good], out.s[good]))


def frozen_double(run: Run) -> ContactLagrangian:
    """Return a copy of the run's model in float64, without gradients."""
    return deepcopy(run.model).cpu().double().requires_grad_(False)
