"""Herglotz's action of any smooth path: the continuous Cauchy problem that L_d discretises."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.scenes.reference import reference_flow
from herglotz.theory.continuous import Lagrangian

Path = Callable[[Tensor], tuple[Tensor, Tensor]]  # t ↦ (q(t), q̇(t)), (...) → (..., n) twice


def path_action(lagrangian: Lagrangian, path: Path, s0: Tensor, T: Tensor | float) -> Tensor:
    """s(T) of ds/dt = L(q(t), q̇(t), s), s(0) = s0, along a path that need not be a motion; shape (...).

    s(T) − s0 is Herglotz's action of the path. Among the paths with the same ends and the same s0 it is stationary
    exactly at the solutions of Herglotz's equations; there it is L_d(q(0), q(T), s0), the exact discrete Lagrangian.

    Parameters
    ----------
    lagrangian
        L(q, v, s).
    path
        t ↦ (q(t), q̇(t)), (...) → (..., n) and (..., n).
    s0
        (...) initial value.
    T
        Final time, () or (...).

    Raises
    ------
    InputError
        If the integration does not converge.

    Source: Cauchy problem and Herglotz action of the paper.
    """

    def field(t: Tensor, _: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return torch.ones_like(t), torch.zeros_like(t), lagrangian(*path(t[..., 0]), s)

    zero = torch.zeros_like(s0)[..., None]
    return reference_flow(field, zero, zero, s0, T)[2]
