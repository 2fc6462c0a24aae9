"""Derivatives of step maps that autograd cannot enter (ONNX, machine code, C), from the file or by differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from herglotz.stepping import State, Step, state_of

# Central differences of order 8 at offsets 1 … 4.
WEIGHTS = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
# Numbers in the second derivatives of the states that step in one batch: steps of an eager model hold a hundred tensors
# of this size (chain of 32 bodies: 14 GB in one batch).
BATCH = 2**20
# Offset relative to 1 + |x_i|: truncation ~ offset⁸ and rounding ~ eps/offset are equal near offset = eps^{1/9}.
OFFSET = {torch.float64: 0.01, torch.float32: 0.1}


def differentiable(stepper: Any, slopes: Callable[[State, float], Tensor]) -> Callable[[State, float], Step]:
    """The step of a stepper, with `slopes` for autograd: the derivative (..., m, m) by (q, p, s), not by h.

    For verification only. `stepper` has `step(state, h) -> Step`.
    """

    def step(state: State, h: float) -> Step:
        x = state.joined
        found = stepper.step(state_of(x.detach()), h)
        if not (torch.is_grad_enabled() and x.requires_grad):
            return found
        y = _Given.apply(x, found.state.joined, slopes(state_of(x.detach()), h))
        return Step(state_of(y), found.c, found.status, found.residual, found.iterations)  # pyright: ignore

    return step


def differenced(stepper: Any, sticks: bool = False) -> Callable[[State, float], Step]:
    """The step of a stepper with a derivative by central differences, 8 (2n + 1) further steps.

    The relative error is about 1e-12 in float64 where the map is smooth over 4 % of its arguments, and about 1e-4 in
    float32. `sticks` says whether dry friction can hold a coordinate (`central_differences`).
    """

    def slopes(state: State, h: float) -> Tensor:
        x = state.joined
        offset = OFFSET[x.dtype] * (1 + x.abs())
        return central_differences(lambda y: stepped(stepper.step, y, h), x, offset, sticks)

    return differentiable(stepper, slopes)


def stepped(step: Callable[[State, float], Step], x: Tensor, h: float) -> Tensor:
    """A step map on points (q, p, s) in one row, (..., 2n+1); NaN where a step fails."""
    return step(state_of(x), h).state.joined


def central_differences(f: Callable[[Tensor], Tensor], x: Tensor, offset: Tensor, sticks: bool = False) -> Tensor:
    """The derivative (..., m, m) of f: (N, m) → (N, m) at x (..., m); x_j moves by 1 … 4 offsets.

    A map with set-valued dry friction (`sticks`) is smooth where no coordinate changes between sliding forward, sliding
    back and standing still. The result is NaN where the points around x differ in this.
    """
    move = torch.stack([torch.diag_embed(k * offset.expand_as(x)) for k in range(1, len(WEIGHTS) + 1)])
    # Row j moves x_j.
    points = torch.stack([x[..., None, :] + move, x[..., None, :] - move])
    m = x.shape[-1]
    ends = torch.cat([f(some) for some in points.reshape(-1, m).split(max(1, BATCH // m**2))]).reshape(points.shape)
    columns = torch.stack([w * change for w, change in zip(WEIGHTS, ends[0] - ends[1], strict=True)]).sum(0)
    slopes = (columns / offset[..., None]).mT
    if not sticks:
        return slopes
    ways = directions(points, ends)  # (2, 4, ..., m, n)
    alike = (ways == ways[:1, :1, ..., :1, :]).all(-1).all(-1).all(0).all(0)
    return torch.where(alike[..., None, None], slopes, torch.nan)


def directions(x: Tensor, y: Tensor) -> Tensor:
    """The sign of each coordinate's move in a step from x to y, (..., 2n+1) each; 0 where it stands still."""
    n = x.shape[-1] // 2
    return (y - x)[..., :n].sign()


class _Given(torch.autograd.Function):
    """y, a function of x with the derivative D, (..., m, m)."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor, D: Tensor) -> Tensor:  # noqa: ARG004  # pyright: ignore
        ctx.save_for_backward(D)
        return y.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (D,) = ctx.saved_tensors
        return (gradients[0][..., None, :] @ D)[..., 0, :], None, None
