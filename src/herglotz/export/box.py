"""Where a model was fitted: the box of states, and the range of steps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from herglotz.models import ContactLagrangian


class Box(nn.Module):
    """Where the model was fitted; angles count modulo 2π. `h_range` is (low, high), or None for any step."""

    low: Tensor  # (2n + 1)
    high: Tensor
    turn: Tensor  # 2π for an angle, else 0
    inverse: Tensor  # 1/2π for an angle, else 0

    def __init__(
        self,
        box: Mapping[str, Sequence[float]],
        angles: Sequence[bool],
        dtype: torch.dtype,
        h_range: Sequence[float] | None = None,
    ):
        super().__init__()
        low = torch.tensor([*box["q_low"], *box["p_low"], *box["s_low"]], dtype=torch.float64)
        high = torch.tensor([*box["q_high"], *box["p_high"], *box["s_high"]], dtype=torch.float64)
        turn = torch.zeros_like(low)
        turn[: len(angles)] = torch.tensor([2 * math.pi * bool(a) for a in angles], dtype=torch.float64)
        inverse = torch.where(turn > 0, 1 / turn, 0.0)
        for name, x in (("low", low), ("high", high), ("turn", turn), ("inverse", inverse)):
            self.register_buffer(name, x.to(dtype))
        self.register_buffer("span", None if h_range is None else torch.tensor(h_range, dtype=dtype))

    @classmethod
    def of(
        cls,
        box: Mapping[str, Sequence[float]] | None,
        model: ContactLagrangian,
        h_range: Sequence[float] | None = None,
    ) -> Box | None:
        """The box of a model, if there is one."""
        return None if box is None else cls(box, model.config.angles, next(model.parameters()).dtype, h_range)

    @property
    def bounds(self) -> tuple[Tensor, ...]:
        """What a loop takes as operands."""
        span = self.span
        return self.low, self.high, self.turn, self.inverse, *((span,) if isinstance(span, Tensor) else ())

    def forward(self, q: Tensor, p: Tensor, s: Tensor) -> Tensor:
        """(...) True where a state lies outside, or is not a number."""
        return beyond((q, p, s), self.bounds)


def beyond(state: tuple[Tensor, ...], bounds: tuple[Tensor, ...]) -> Tensor:
    """(...) True where a state lies outside bounds, or is not a number."""
    q, p, s = state
    low, high, turn, inverse = bounds[:4]
    x = torch.cat([q, p, s[..., None]], -1)
    x = x - turn * torch.round((x - (low + high) / 2) * inverse)
    return ~((x >= low) & (x <= high)).all(-1)


def outside(
    bounds: tuple[Tensor, ...], h: Tensor, before: tuple[Tensor, ...], after: tuple[Tensor, ...]
) -> tuple[Tensor, ...]:
    """(outside,) where there are bounds, uint8: 1 where the step starts or ends beyond them, and 2 where h does."""
    if not bounds:
        return ()
    flags = (beyond(before, bounds) | beyond(after, bounds)).to(torch.uint8)
    if len(bounds) > 4:
        span = bounds[4]
        flags = torch.where((h >= span[0]) & (h <= span[1]), flags, flags + 2)
    return (flags,)
