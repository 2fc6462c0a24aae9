"""Reference motions of a search: rollouts of the run's own model from starts inside its box."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass

import torch

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, Stepper
from herglotz.training import Run

REFERENCES = ("own", "limit")
FINEST = 4  # states that the reference "limit" records in one step of the run
INNER = 8  # steps between two such states; twice as many give the Richardson estimate
JITTER = 0.05  # share of the box by which a start is moved away from a recorded state


@dataclass(frozen=True)
class Motions:
    """B motions at equal times `base` apart, from the reference stepper, in float64."""

    base: float
    states: State  # (B, K+1, n), (B, K+1, n), (B, K+1)
    error: (
        float  # estimated largest error of the reference in q; 0 for the reference "own", which is exact by definition
    )

    def every(self, stride: int) -> State:
        """Return the states `stride` bases apart."""
        return State(*(x[:, ::stride] for x in self.states))

    def starts(self) -> State:
        """Return the states at time 0, (B, n), (B, n), (B,)."""
        return State(*(x[:, 0] for x in self.states))


def draw_starts(run: Run, count: int, seed: int) -> State:
    """Draw states near recorded ones: a random sample of the run, moved by up to 5 % of the box, inside the box.

    A uniform draw would fill the corners of the box too, where no data hold the model.
    """
    generator = torch.Generator().manual_seed(seed)
    trained = [
        torch.arange(first, first + length) for first, length in zip(run.data.offsets, run.train_lengths, strict=True)
    ]
    rows = torch.cat(trained)
    fine = torch.stack([x.reshape(len(x), -1).isfinite().all(-1).cpu() for x in run.states]).all(0)
    rows = rows[fine[rows]]
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


def record(run: Run, starts: State, horizon: float, reference: str) -> Motions:
    """Return motions over `horizon` from these starts; motions that fail are left out.

    Parameters
    ----------
    reference
        "own": the run's model at the run's own step; the run has measured the error of this flow against the data.
        "limit": the model as h → 0, by Richardson extrapolation; refused for a model with a learned correction, which
        is right at its own step only.

    Raises
    ------
    InputError
        If the limit is asked for where there is none, or more than half of the motions fail.
    """
    own = Stepper(frozen_double(run))
    if reference == "own":
        base, steps = run.h, round(horizon / run.h)
        states, error = _roll(own, starts, base, steps, 1), torch.zeros_like(starts.s)
    else:
        if run.model.correction is not None:
            raise InputError("a learned correction is right at its own step only; tune this run with --reference own")
        base = run.h / FINEST
        steps = round(horizon / base)
        coarse, fine = (_roll(own, starts, base, steps, INNER * k) for k in (1, 2))
        error = (fine.q - coarse.q).abs().flatten(1).amax(1) / 3
        states = State(*((4 * b - a) / 3 for a, b in zip(coarse, fine, strict=True)))
    good = torch.stack([x.flatten(1).isfinite().all(1) for x in states]).all(0)
    if int(good.sum()) * 2 < len(good):
        raise InputError(
            f"the run's own stepper fails on {int((~good).sum())} of {len(good)} starts over {horizon:g}; "
            "take a shorter --horizon"
        )
    return Motions(base, State(*(x[good] for x in states)), float(error[good].max()))


def frozen_double(run: Run) -> ContactLagrangian:
    """Return a copy of the run's model in float64, without gradients."""
    return deepcopy(run.model).cpu().double().requires_grad_(False)


def _roll(stepper: Stepper, starts: State, base: float, steps: int, inner: int) -> State:
    with torch.no_grad():
        out = stepper.rollout(*starts, h=base / inner, steps=steps * inner, every=inner)
    return State(out.q, out.p, out.s)
