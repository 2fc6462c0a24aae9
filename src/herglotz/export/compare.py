"""The difference between an exported stepper and the eager one over rollouts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.export.metadata import weights_digest
from herglotz.stepping import Rollout, State, Stepper, state_of

# Starts that the eager stepper is run from; a larger batch of the file repeats them.
MAX_STARTS = 64


def compare(
    exported: Any,
    stepper: Stepper,
    *,
    batches: Sequence[int] = (1, 7, 4096),
    steps: int = 1000,
    h: float | None = None,
    states: State | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Largest difference between two rollouts from the same starts, relative to the largest eager value.

    Each rollout goes on from its own states, so that differences grow as in use. The inputs of a model with inputs are
    uniform random numbers in [−1, 1].

    Parameters
    ----------
    exported
        The stepper of a file.
    stepper
        The eager stepper of the same model, in the same dtype.
    batches
        Batch sizes; 1 and a prime number find specialised graphs. A batch of more than 64 repeats starts in a random
        order: every sample of the file is compared with the eager rollout of its start.
    steps, h
        Length and step of the rollouts; h defaults to the file's own.
    states
        States to draw the starts from; default: uniform in the file's box, or in [−1, 1] where the file has no box.
    seed
        Seed of the draw.

    Returns
    -------
    dict
        `q`, `p`, `s`, `c` (largest over batches), `status` (samples whose statuses differ), `failed` (samples with a
        failed step), `same_weights` (None where the stepper's L_d is no module), `per_batch` {B: {...}}.
    """
    if not batches or min(batches) < 1:
        raise InputError(f"batches must be sizes >= 1, got {list(batches)}")
    size_of_step = float(exported.h) if h is None else h
    make = torch.Generator().manual_seed(seed)
    inputs = getattr(stepper.L_d, "inputs", 0)
    per_batch = {}
    for size in batches:
        few = min(size, MAX_STARTS)
        start = draw(exported, few, make) if states is None else _pick(states, few, make)
        order = torch.arange(few)
        if size > few:
            order = torch.cat([order, torch.randint(few, (size - few,), generator=make)])
        with torch.no_grad():
            u = None
            if inputs:
                u = 2 * torch.rand(few, steps, inputs, generator=make, dtype=torch.float64).to(start[0]) - 1
            mine = None if u is None else u[order]
            ours = exported.rollout(*(x[order] for x in start), h=size_of_step, steps=steps, inputs=mine)
            eager = stepper.rollout(*start, h=size_of_step, steps=steps, inputs=u)
        per_batch[int(size)] = _difference(ours, eager, order)
    worst: dict[str, Any] = {key: max(x[key] for x in per_batch.values()) for key in ("q", "p", "s", "c")}
    totals = {key: sum(x[key] for x in per_batch.values()) for key in ("status", "failed")}
    same = None
    if isinstance(stepper.L_d, torch.nn.Module):
        same = weights_digest(stepper.L_d) == exported.metadata.get("weights_sha256")
    return {**worst, **totals, "same_weights": same, "per_batch": per_batch}


def draw(exported: Any, size: int, generator: torch.Generator) -> State:
    """States drawn uniformly from the file's box, or from [−1, 1] where the file has no box."""
    box = exported.metadata["box"]
    unit = torch.rand(size, 2 * exported.dof + 1, generator=generator, dtype=torch.float64)
    low, high = -torch.ones_like(unit[0]), torch.ones_like(unit[0])
    if box is not None:
        low = torch.tensor(box["q_low"] + box["p_low"] + box["s_low"], dtype=torch.float64)
        high = torch.tensor(box["q_high"] + box["p_high"] + box["s_high"], dtype=torch.float64)
    return state_of((low + (high - low) * unit).to(exported.dtype))


def _pick(states: State, size: int, generator: torch.Generator) -> State:
    index = torch.randint(len(states.s), (size,), generator=generator)
    return State(*(x[index] for x in states))


def _difference(ours: Rollout, eager: Rollout, order: Tensor) -> dict[str, Any]:
    """The differences between sample i of ours and sample order[i] of the eager rollout."""
    eager = Rollout(*(getattr(eager, name)[order] for name in ("q", "p", "s", "sigma", "status", "residual")))
    failed = (~ours.ok) | (~eager.ok)
    keep = ~failed
    pairs = {
        "q": (ours.q, eager.q),
        "p": (ours.p, eager.p),
        "s": (ours.s, eager.s),
        "c": (ours.sigma[..., 1:] / ours.sigma[..., :-1], eager.sigma[..., 1:] / eager.sigma[..., :-1]),
    }
    result: dict[str, Any] = {name: _relative(a[keep], b[keep]) for name, (a, b) in pairs.items()}
    result["status"] = int(((ours.status != 0) != (eager.status != 0)).any(-1).sum())
    result["failed"] = int(failed.sum())
    return result


def _relative(a: Tensor, b: Tensor) -> float:
    """Largest |a − b| over the largest |b|; NaN for empty tensors."""
    if not a.numel():
        return float("nan")
    return float((a - b).abs().max() / b.abs().max().clamp_min(torch.finfo(b.dtype).tiny))
