"""What every exported stepper checks before it steps: shapes, dtype, finite values and h > 0."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import InputError


def check_state(q: Tensor, p: Tensor, s: Tensor, dof: int, dtype: torch.dtype) -> None:
    """Refuse a state that the file was not written for.

    Parameters
    ----------
    q, p, s
        (..., n), (..., n), (...).
    dof, dtype
        n and the dtype of the file.

    Raises
    ------
    InputError
        Naming the argument, what is wrong and the remedy.
    """
    if q.ndim < 1 or q.shape[-1] != dof or p.shape != q.shape or s.shape != q.shape[:-1]:
        shapes = [tuple(x.shape) for x in (q, p, s)]
        raise InputError(f"q, p, s need shapes (..., {dof}), (..., {dof}), (...); got {shapes}")
    if s.numel() == 0:
        raise InputError("q, p, s hold no samples; give at least one")
    for name, x in (("q", q), ("p", p), ("s", s)):
        if x.dtype != dtype:
            raise InputError(f"{name} must be {dtype}, got {x.dtype}; convert it with .to({dtype})")
        if not bool(torch.isfinite(x).all()):
            raise InputError(f"{name} must be finite, got {int((~torch.isfinite(x)).sum())} values that are not")


def checked_h(h: Tensor | float, dtype: torch.dtype) -> Tensor:
    """H as a tensor, every entry finite and > 0."""
    h = torch.as_tensor(h, dtype=dtype)
    if h.numel() == 0 or not bool(((h > 0) & torch.isfinite(h)).all()):
        raise InputError(f"h must be finite and > 0, got {float(h.min()) if h.numel() else 'none'}")
    return h
