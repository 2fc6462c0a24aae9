"""What exported steppers check before they step: shapes, dtype, values and h."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from herglotz.errors import InputError


def check_state(
    q: Tensor,
    p: Tensor,
    s: Tensor,
    dof: int,
    dtype: torch.dtype,
    names: tuple[str, str, str] = ("q", "p", "s"),
    finite: bool = True,
) -> None:
    """Refuse a state that the file was not written for.

    Parameters
    ----------
    q, p, s
        (..., n), (..., n), (...).
    dof, dtype
        n and the dtype of the file.
    names
        What the caller calls the three.
    finite
        Whether every value has to be.

    Raises
    ------
    InputError
        Naming the argument, what is wrong and the remedy.
    """
    if q.ndim < 1 or q.shape[-1] != dof or p.shape != q.shape or s.shape != q.shape[:-1]:
        shapes = [tuple(x.shape) for x in (q, p, s)]
        raise InputError(f"{', '.join(names)} need shapes (..., {dof}), (..., {dof}), (...); got {shapes}")
    if s.numel() == 0:
        raise InputError(f"{', '.join(names)} hold no samples; give at least one")
    for name, x in zip(names, (q, p, s), strict=True):
        if x.dtype != dtype:
            raise InputError(f"{name} must be {dtype}, got {x.dtype}; convert it with .to({dtype})")
        if finite and not bool(torch.isfinite(x).all()):
            raise InputError(f"{name} must be finite, got {int((~torch.isfinite(x)).sum())} values that are not")


def checked_h(h: Tensor | float, dtype: torch.dtype) -> Tensor:
    """H as a tensor, every entry finite and > 0."""
    h = torch.as_tensor(h, dtype=dtype)
    if h.numel() == 0 or not bool(((h > 0) & torch.isfinite(h)).all()):
        raise InputError(f"h must be finite and > 0, got {float(h.min()) if h.numel() else 'none'}")
    return h


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
    """Refuse inputs u that the model does not take: shape (*shape, m), finite, of the file's dtype."""
    if count == 0:
        raise InputError("the model takes no inputs; leave u out")
    if u.shape != (*shape, count) or u.dtype != dtype or not bool(torch.isfinite(u).all()):
        raise InputError(f"u needs {count} finite number(s) a step in {dtype}, got {tuple(u.shape)} in {u.dtype}")
