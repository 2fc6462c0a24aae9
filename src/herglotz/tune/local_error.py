"""Local errors of a rollout: each step is compared with two steps of half its length. No status shows these errors."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.stepping import OneStepMethod, Rollout, State, Status
from herglotz.stepping.state import check_h


def local_errors(stepper: OneStepMethod, out: Rollout, h: Tensor | float) -> Tensor:
    """Return |q after a step − q after two half steps|, the largest coordinate, over the step's move; (..., K).

    Values near 1 and above mean that h does not resolve the motion, even where every step equation was solved: a step
    over the pericentre of a thin ellipse is as regular as any other. For a method of order p the value estimates the
    error of the step times 1 − 2^{−p}. The estimate takes two steps for each step of the rollout. Values for a model
    with a learned correction mean nothing, because a correction is right at its own step only.

    The stepper made the rollout `out` without inputs, with every step kept, by the step h: a scalar, (K,) or (..., K).
    Raise InputError if h lists another number of steps than the rollout keeps.
    """
    h, steps = check_h(h, out.q), out.status.shape[-1]
    if h.ndim and h.shape[-1] != steps:
        raise InputError(f"h lists {h.shape[-1]} steps, but {steps} were kept; keep every step")
    half = h.expand(out.status.shape) / 2
    start, whole = State(out.q[..., :-1, :], out.p[..., :-1, :], out.s[..., :-1]), out.q[..., 1:, :]
    # All steps are one batch.
    with torch.no_grad():
        end = stepper.step(stepper.step(start, half).state, half).state.q
    moved = torch.maximum((whole - start.q).abs().amax(-1), (end - start.q).abs().amax(-1))
    return (whole - end).abs().amax(-1) / moved.clamp(min=torch.finfo(end.dtype).tiny)


def flag_unresolved(stepper: OneStepMethod, out: Rollout, h: Tensor | float, bound: float = 0.1) -> Rollout:
    """Return the rollout with `Status.UNRESOLVED` at every converged step whose `local_errors` exceed a bound.

    The states stay as they are; `Rollout.ok` is then False for a motion that is finite and wrong, such as one that
    crosses the pericentre of a thin ellipse in a single step. A half step that fails is unresolved too. `bound` > 0 is
    the error of a step relative to its move; the other arguments are those of `local_errors`, with the same caution
    about learned corrections. Raise InputError if the bound is not a finite number > 0, or `local_errors` refuses h.
    """
    if not 0 < bound < float("inf"):
        raise InputError(f"bound must be a finite number > 0, got {bound:g}")
    wrong = ~(local_errors(stepper, out, h) <= bound) & (out.status == Status.CONVERGED)
    return replace(out, status=torch.where(wrong, int(Status.UNRESOLVED), out.status.int()).to(torch.uint8))
