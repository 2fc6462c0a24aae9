"""What the inputs do between samples, where neither the data nor the user say it: the hold that explains the steps.

Each hold makes other inputs of the steps, and one linear problem (`dry_friction.acceleration_terms` and the signs of
the velocities) is solved for each with as many unknowns. A hold other than "zero" is taken where it explains the
accelerations better, beyond the spread of that difference over blocks of time.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.holds import HOLDS
from herglotz.least_squares import least_squares
from herglotz.training.dry_friction import BLOCKS, acceleration_terms

CLEARLY = 2.0  # standard errors of the difference


def with_hold(data: Trajectories, wanted: str, train: Trajectories) -> tuple[Trajectories, str]:
    """The data with what their inputs do between samples, and the reason.

    Parameters
    ----------
    data
        All samples.
    wanted
        One of `HOLDS`, or "": as the data say or, where they say nothing, as explains the steps of `train`.
    train
        The part of the data that a fit may see.
    """
    if data.u is None:
        return data, "there are no inputs"
    if wanted:
        return replace(data, hold=wanted), "as planned"
    if data.hold:
        return data, "the data say so"
    errors = {hold: _errors(replace(train, hold=hold)) for hold in HOLDS}
    best = min(HOLDS, key=lambda hold: float(errors[hold].mean()))
    gain = errors["zero"] - errors[best]
    found = best if float(gain.mean()) > CLEARLY * float(gain.std()) / BLOCKS**0.5 else "zero"
    said = ", ".join(f"{hold} {float(e.mean().sqrt()):.3g}" for hold, e in errors.items())
    return replace(data, hold=found), f"RMS error of a linear model of the accelerations: {said}"


def _errors(train: Trajectories) -> Tensor:
    """Mean squares over blocks of time, (BLOCKS,)."""
    a, columns, v = acceleration_terms(train)
    A, y = torch.cat([columns, torch.diag_embed(v.sign())], -1).flatten(0, 1).cpu(), a.reshape(-1, 1).cpu()
    A = A / A.square().mean(0).sqrt().clamp_min(torch.finfo(A.dtype).tiny)
    left = A @ least_squares(A, y) - y
    return torch.stack([block.square().mean() for block in left.tensor_split(BLOCKS)])
