"""What exported steppers check before they step, beside what every stepper does: the range of h, and inputs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from herglotz.errors import InputError


def check_range(h: Tensor, span: Sequence[float] | None) -> None:
    """Refuse a step outside the range that the file records, if it records one."""
    if span is None:
        return
    slack = 4 * torch.finfo(h.dtype).eps
    if float(h.min()) < span[0] * (1 - slack) or float(h.max()) > span[1] * (1 + slack):
        found = " … ".join(dict.fromkeys(f"{float(x):g}" for x in (h.min(), h.max())))
        raise InputError(
            f"h must lie in [{span[0]:g}, {span[1]:g}], where the model was fitted; got {found}. "
            "Export it with another --h-range (h_range in Python) to step elsewhere"
        )


def spread_h(h: Tensor, like: Tensor) -> Tensor:
    """H for every sample of the batch `like`.

    Raises
    ------
    InputError
        If it is neither a scalar nor of that shape.
    """
    pairs = zip(h.shape[::-1], like.shape[::-1], strict=False)
    if h.ndim > like.ndim or not all(a in (1, b) for a, b in pairs):
        raise InputError(f"h must be a scalar or match the batch {tuple(like.shape)}, got shape {tuple(h.shape)}")
    return h.expand(like.shape)


def check_inputs(u: Tensor, count: int, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """Refuse inputs u that the model does not take: shape (*shape, m), of the file's dtype."""
    if count == 0:
        raise InputError("the model takes no inputs; leave u out")
    if u.shape != (*shape, count) or u.dtype != dtype:
        raise InputError(f"u needs {count} number(s) a step in {dtype}, got {tuple(u.shape)} in {u.dtype}")
