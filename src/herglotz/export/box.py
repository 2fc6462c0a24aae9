"""Where a model was fitted (the box of states, the range of steps), and what steps report of themselves."""

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
    """Where the model was fitted; angles count modulo 2π. `h_range` is (low, high), or None for any step."""

    def __init__(
        self,
        box: Mapping[str, Sequence[float]],
        angles: Sequence[bool],
        dtype: torch.dtype,
        h_range: Sequence[float] | None = None,
        by_s: bool = True,  # whether s counts: it grows without bound, and matters only where the motion depends on it
    ):
        self.by_s = by_s
        names = "qps" if by_s else "qp"
        low, high = (
            torch.tensor([x for name in names for x in box[f"{name}_{end}"]], dtype=torch.float64)
            for end in ("low", "high")
        )
        turn = torch.zeros_like(low)
        turn[: len(angles)] = torch.tensor([2 * math.pi * bool(a) for a in angles], dtype=torch.float64)
        inverse = torch.where(turn > 0, 1 / turn, 0.0)  # 1/2π for an angle, else 0
        self.low, self.high, self.turn, self.inverse = (x.to(dtype) for x in (low, high, turn, inverse))
        self.span = None if h_range is None else torch.tensor(h_range, dtype=dtype)

    @classmethod
    def of(
        cls, box: Mapping[str, Sequence[float]] | None, model: ContactLagrangian, h_range: Sequence[float] | None = None
    ) -> Box | None:
        """The box of a model, if there is one."""
        if box is None:
            return None
        return cls(box, model.config.angles, next(model.parameters()).dtype, h_range, model.s_enters_motion)

    def __call__(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """(...) True where a state lies outside, or is not a number."""
        x = torch.cat([q, p, s[..., None]] if self.by_s else [q, p], -1)
        x = x - self.turn * torch.round((x - (self.low + self.high) / 2) * self.inverse)
        return ~((x >= self.low) & (x <= self.high)).all(-1)

    def flags(self, h: Tensor, before: tuple[Tensor, ...], after: tuple[Tensor, ...]) -> Tensor:
        """(...) uint8: 1 where a step starts or ends outside, plus 2 where h is beyond its range."""
        flags = (self(*before) | self(*after)).to(torch.uint8)
        if self.span is None:
            return flags
        return torch.where((h >= self.span[0]) & (h <= self.span[1]), flags, flags + 2)


def s_matters(metadata: Mapping[str, Any]) -> bool:
    """Whether the motion of a file's model depends on s, by its level."""
    return metadata.get("level") in ("affine", "full")


def report(box: Box | None, h: Tensor, *x: Tensor) -> tuple[Tensor, ...]:
    """q1, p1, s1, c, residual, status[, outside]: what a step says of itself, NaN where it failed.

    x is (q, p, s) before and after the step, then c, then the residual and status of steps that iterate.
    """
    before, (q1, p1, s1), (c, *solved) = x[:3], x[3:6], x[6:]
    residual, said = solved or (0.0 * c, None)
    sound = torch.isfinite(residual + s1) & torch.isfinite(q1 + p1).all(-1)
    status = torch.where(sound, int(Status.CONVERGED), int(Status.DIVERGED)).to(torch.uint8)
    if said is not None:
        status = torch.where(said != int(Status.CONVERGED), said, status)
    status = torch.where(c == 0, int(Status.SINGULAR), status)
    status = torch.where((h > 0) & torch.isfinite(h), status, int(Status.BAD_INPUT)).to(torch.uint8)
    nan = torch.where(status == int(Status.CONVERGED), 0.0, torch.nan).to(q1.dtype)
    new = (q1 + nan[:, None], p1 + nan[:, None], s1 + nan)
    outside = () if box is None else (box.flags(h, before, new),)
    return tuple(dense(y) for y in (*new, c + nan, residual, status, *outside))
