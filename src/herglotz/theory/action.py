"""Discrete Lagrangian dynamics: the Herglotz action of any discrete curve q_0 … q_N and its gradient."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.errors import InputError
from herglotz.mechanics.legendre import momentum_residual
from herglotz.mechanics.partials import DiscreteLagrangian, Partials, partials, value
from herglotz.theory.left import unforced


@dataclass(frozen=True)
class Action:
    """The action variable s_k along a discrete curve, and the first variation of s_N."""

    s: Tensor  # (..., N+1) s_0 … s_N
    sigma: Tensor  # (..., N+1) σ_k = ∏_{j<k} c_j; ∂s_N/∂s_0 = σ_N
    residual: Tensor  # (..., N−1, n) R_1 … R_{N−1}, the discrete Herglotz residuals
    gradient: Tensor  # (..., N+1, n) ∂s_N/∂q_k


def curve_action(
    L_d: DiscreteLagrangian,
    q: Tensor,  # (..., N+1, n)
    s0: Tensor,  # (...)
    h: Tensor | float,  # (), (N,) or (..., N)
) -> Tensor:
    """s_0 … s_N with s_{k+1} = s_k + L_d(q_k, q_{k+1}, s_k), shape (..., N+1).

    Raise InputError if the curve has fewer than two points or h does not fit.  Source: discrete Cauchy problem of the
    paper.
    """
    sizes = curve_steps(q, h)
    s = [s0.expand(q.shape[:-2])]
    for k in range(q.shape[-2] - 1):
        s.append(s[-1] + value(L_d, q[..., k, :], q[..., k + 1, :], s[-1], sizes[..., k]))
    return torch.stack(s, -1)


def herglotz_action(L_d: DiscreteLagrangian, q: Tensor, s0: Tensor, h: Tensor | float) -> Action:
    """The action s_N[q_0 … q_N; s_0] and its gradient in closed form.

    q_k enters L_d(q_{k−1}, q_k) and L_d(q_k, q_{k+1}); all later steps depend on q_k through s alone. Hence

        ∂s_N/∂q_k = (∏_{j>k} c_j) R_k,    R_k = D1L_d(q_k, q_{k+1}, s_k) + c_k D2L_d(q_{k−1}, q_k, s_{k−1})

    with R_0 = D1L_d and, at the last point, ∂s_N/∂q_N = D2L_d = p_N. The gradients at interior points vanish exactly on
    the solutions of the discrete Herglotz equations. Raise InputError if the curve has fewer than two points, h does
    not fit, or L_d comes with forces.  Source: discrete Herglotz action and equations of the paper, indices by erratum
    E3.
    """
    s = curve_action(L_d, q, s0, h)
    P = curve_partials(L_d, q, s, h)
    later = P.map(lambda x: x.narrow(P.L.ndim - 1, 1, s.shape[-1] - 2))
    residual = momentum_residual(later, P.D2[..., :-1, :])
    one = torch.ones_like(s[..., :1])
    sigma = torch.cat([one, P.c.cumprod(-1)], -1)
    # The product of the factors after k is not formed by division, because a factor c may be 0.
    after = torch.cat([P.c[..., 1:].flip(-1).cumprod(-1).flip(-1), one], -1)
    rows = torch.cat([P.D1[..., :1, :], residual], -2) * after[..., None]
    return Action(s, sigma, residual, torch.cat([rows, P.D2[..., -1:, :]], -2))


def curve_partials(L_d: DiscreteLagrangian, q: Tensor, s: Tensor, h: Tensor | float, order: int = 1) -> Partials:
    """Partials of all N steps of a curve at once; every entry has a step axis, (..., N, *)."""
    return unforced(partials(L_d, q[..., :-1, :], q[..., 1:, :], s[..., :-1], curve_steps(q, h), order))


def curve_steps(q: Tensor, h: Tensor | float) -> Tensor:
    """The sizes h of all steps of a curve, shape (..., N).

    Raise InputError if the curve has fewer than two points or h is not positive or does not fit.
    """
    if q.ndim < 2 or q.shape[-2] < 2:
        raise InputError(f"a discrete curve needs shape (..., N+1, n) with N >= 1, got {tuple(q.shape)}")
    h = torch.as_tensor(h, dtype=q.dtype, device=q.device)
    shape = (*q.shape[:-2], q.shape[-2] - 1)
    try:
        h = h.broadcast_to(shape)
    except RuntimeError:
        raise InputError(
            f"a curve of {shape[-1]} steps needs h of shape (), (N,) or (..., N), got {tuple(h.shape)}"
        ) from None
    if not bool((h > 0).all()):
        raise InputError(f"h must be > 0, got {float(h.min()):g}")
    return h
