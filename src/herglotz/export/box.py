"""The box of states that a model was fitted in."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from herglotz.models import ContactLagrangian


class Box(nn.Module):
    """Where the model was fitted; angles count modulo 2π."""

    low: Tensor  # (2n + 1)
    high: Tensor
    turn: Tensor  # 2π for an angle, else 0
    inverse: Tensor  # 1/2π for an angle, else 0

    def __init__(self, box: Mapping[str, Sequence[float]], angles: Sequence[bool], dtype: torch.dtype):
        super().__init__()
        low = torch.tensor([*box["q_low"], *box["p_low"], *box["s_low"]], dtype=torch.float64)
        high = torch.tensor([*box["q_high"], *box["p_high"], *box["s_high"]], dtype=torch.float64)
        turn = torch.zeros_like(low)
        turn[: len(angles)] = torch.tensor([2 * math.pi * bool(a) for a in angles], dtype=torch.float64)
        inverse = torch.where(turn > 0, 1 / turn, 0.0)
        for name, x in (("low", low), ("high", high), ("turn", turn), ("inverse", inverse)):
            self.register_buffer(name, x.to(dtype))

    @classmethod
    def of(cls, box: Mapping[str, Sequence[float]] | None, model: ContactLagrangian) -> Box | None:
        """The box of a model, if there is one."""
        return None if box is None else cls(box, model.config.angles, next(model.parameters()).dtype)

    @property
    def bounds(self) -> tuple[Tensor, ...]:
        """What a loop takes as operands."""
        return self.low, self.high, self.turn, self.inverse

    def forward(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """(...) True where a state lies outside, or is not a number."""
        return beyond((q, p, s), self.bounds)


def beyond(state: tuple[Tensor, ...], bounds: tuple[Tensor, ...]) -> Tensor:
    """(...) True where a state lies outside bounds, or is not a number."""
    q, p, s = state
    low, high, turn, inverse = bounds
    x = torch.cat([q, p, s[..., None]], -1)
    x = x - turn * torch.round((x - (low + high) / 2) * inverse)
    return ~((x >= low) & (x <= high)).all(-1)


def outside(bounds: tuple[Tensor, ...], before: tuple[Tensor, ...], after: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """(outside,) where there are bounds, uint8: 1 where the step starts or ends beyond them."""
    return ((beyond(before, bounds) | beyond(after, bounds)).to(torch.uint8),) if bounds else ()
