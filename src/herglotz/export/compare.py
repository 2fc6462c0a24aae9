"""An exported stepper held against the eager one over many fed-back steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.export.loader import ExportedStepper
from herglotz.stepping import Rollout, State, Stepper


def compare(
    exported: ExportedStepper,
    stepper: Stepper,
    *,
    batches: Sequence[int] = (1, 7, 4096),
    steps: int = 20,
    h: float | None = None,
    states: State | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Largest difference between two rollouts from the same starts, relative to the largest eager value.

    Each rollout feeds its own states back, so that a difference grows as it would in use.

    Parameters
    ----------
    exported, stepper
        The file and the eager stepper of the same model, in the same dtype.
    batches
        Batch sizes; 1 and a prime number find specialised graphs.
    steps, h
        Length and step of the rollouts; h defaults to the file's own.
    states
        Where starts are drawn from; default the file's box, or the unit cube where it records none.
    seed
        Of the draw.

    Returns
    -------
    dict
        `q`, `p`, `s`, `c` (largest over batches), `status` (samples whose statuses differ), `failed` (samples with a
        failed step), `per_batch` {B: {...}}.
    """
    if not batches or min(batches) < 1:
        raise InputError(f"batches must be sizes >= 1, got {list(batches)}")
    h = exported.h if h is None else h
    make = torch.Generator().manual_seed(seed)
    per_batch = {}
    for size in batches:
        start = draw(exported, size, make) if states is None else _pick(states, size, make)
        with torch.no_grad():
            ours = exported.rollout(*start, h=h, steps=steps)
            eager = stepper.rollout(*start, h=h, steps=steps)
        per_batch[int(size)] = _difference(ours, eager)
    worst: dict[str, Any] = {key: max(one[key] for one in per_batch.values()) for key in ("q", "p", "s", "c")}
    totals = {key: sum(one[key] for one in per_batch.values()) for key in ("status", "failed")}
    return {**worst, **totals, "per_batch": per_batch}


def draw(exported: ExportedStepper, size: int, generator: torch.Generator) -> State:
    """States drawn uniformly from the file's box, or from [−1, 1] where it records none."""
    box = exported.metadata["box"]
    unit = torch.rand(size, 2 * exported.dof + 1, generator=generator, dtype=torch.float64)
    low, high = -torch.ones_like(unit[0]), torch.ones_like(unit[0])
    if box is not None:
        low = torch.tensor(box["q_low"] + box["p_low"] + box["s_low"], dtype=torch.float64)
        high = torch.tensor(box["q_high"] + box["p_high"] + box["s_high"], dtype=torch.float64)
    x = (low + (high - low) * unit).to(exported.dtype)
    return State(x[:, : exported.dof], x[:, exported.dof : 2 * exported.dof], x[:, -1])


def _pick(states: State, size: int, generator: torch.Generator) -> State:
    index = torch.randint(len(states.s), (size,), generator=generator)
    return State(states.q[index], states.p[index], states.s[index])


def _difference(ours: Rollout, eager: Rollout) -> dict[str, Any]:
    failed = (~ours.ok) | (~eager.ok)
    keep = ~failed
    pairs = {
        "q": (ours.q, eager.q),
        "p": (ours.p, eager.p),
        "s": (ours.s, eager.s),
        "c": (ours.sigma[..., 1:] / ours.sigma[..., :-1], eager.sigma[..., 1:] / eager.sigma[..., :-1]),
    }
    result: dict[str, Any] = {name: _relative(a[keep], b[keep]) for name, (a, b) in pairs.items()}
    result["status"] = int((ours.status != eager.status).any(-1).sum())
    result["failed"] = int(failed.sum())
    return result


def _relative(a: Tensor, b: Tensor) -> float:
    """Largest |a − b| over the largest |b|; NaN where nothing is left to compare."""
    if not a.numel():
        return float("nan")
    return float((a - b).abs().max() / b.abs().max().clamp_min(torch.finfo(b.dtype).tiny))
