"""The box of states and the range of steps that a model was fitted in, and the outputs of a step in a file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from herglotz.export.equation import dense
from herglotz.models import ContactLagrangian
from herglotz.stepping import Status


class Box:
    """The box of states that the model was fitted in; angles count modulo 2π.

    `h_range` is (low, high), or None for any step. The action s grows without bound; `by_s` is true where the motion
    depends on s, and only then s counts.
    """

    def __init__(
        self,
        box: Mapping[str, Sequence[float]],
        angles: Sequence[bool],
        dtype: torch.dtype,
        h_range: Sequence[float] | None = None,
        by_s: bool = True,
    ):
        self.by_s = by_s
        names = "qps" if by_s else "qp"
        low, high = (
            torch.tensor([x for name in names for x in box[f"{name}_{end}"]], dtype=torch.float64)
            for end in ("low", "high")
        )
        turn = torch.zeros_like(low)
        turn[: len(angles)] = torch.tensor([2 * math.pi * bool(a) for a in angles], dtype=torch.float64)
        turns_per_radian = torch.where(turn > 0, 1 / turn, 0.0)
        values = low, high, turn, turns_per_radian
        self.low, self.high, self.turn, self.turns_per_radian = (x.to(dtype) for x in values)
        self.span = None if h_range is None else torch.tensor(h_range, dtype=dtype)

    @classmethod
    def of(
        cls, box: Mapping[str, Sequence[float]] | None, model: ContactLagrangian, h_range: Sequence[float] | None = None
    ) -> Box | None:
        """The box of a model; None where no box is recorded."""
        if box is None:
            return None
        return cls(box, model.config.angles, next(model.parameters()).dtype, h_range, model.s_enters_motion)

    def __call__(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """(...) True where a state lies outside the box or has a NaN."""
        x = torch.cat([q, p, s[..., None]] if self.by_s else [q, p], -1)
        x = x - self.turn * torch.round((x - (self.low + self.high) / 2) * self.turns_per_radian)
        return ~((x >= self.low) & (x <= self.high)).all(-1)

    def flags(self, h: Tensor, before: tuple[Tensor, ...], after: tuple[Tensor, ...]) -> Tensor:
        """(...) uint8: 1 where a step starts or ends outside the box, plus 2 where h is outside `h_range`."""
        flags = (self(*before) | self(*after)).to(torch.uint8)
        if self.span is None:
            return flags
        return torch.where((h >= self.span[0]) & (h <= self.span[1]), flags, flags + 2)


def s_matters(metadata: Mapping[str, Any]) -> bool:
    """Whether the motion of a file's model depends on s; the model's level decides."""
    return metadata.get("level") in ("affine", "full")


def report(box: Box | None, h: Tensor, *x: Tensor) -> tuple[Tensor, ...]:
    """The outputs of a step, q1, p1, s1, c, residual, status[, outside]; the first four are NaN where the step failed.

    x is (q, p, s) before and after the step, then c, then the residual and status of steps that iterate.
    """
    before, (q1, p1, s1), (c, *solved) = x[:3], x[3:6], x[6:]
    residual, newton_status = solved or (0.0 * c, None)
    finite = torch.isfinite(residual + s1) & torch.isfinite(q1 + p1).all(-1)
    status = torch.where(finite, int(Status.CONVERGED), int(Status.DIVERGED)).to(torch.uint8)
    if newton_status is not None:
        status = torch.where(newton_status != int(Status.CONVERGED), newton_status, status)
    status = torch.where(c == 0, int(Status.SINGULAR), status)
    status = torch.where((h > 0) & torch.isfinite(h), status, int(Status.BAD_INPUT)).to(torch.uint8)
    nan = torch.where(status == int(Status.CONVERGED), 0.0, torch.nan).to(q1.dtype)
    new = (q1 + nan[:, None], p1 + nan[:, None], s1 + nan)
    outside = () if box is None else (box.flags(h, before, new),)
    return tuple(dense(y) for y in (*new, c + nan, residual, status, *outside))
