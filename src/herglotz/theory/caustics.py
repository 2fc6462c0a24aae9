"""Caustics of a family of discrete solutions: where the positions stop depending on the parameter one to one."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import Partials, step_derivative


@dataclass(frozen=True)
class Opening:
    """How a family of solutions with n parameters has opened after N steps."""

    final: Tensor  # (...) smallest singular value of Y_N over the largest norm of any Y_k; 0 at a caustic
    crossed: Tensor  # (...) first step k on which ∂q_{k+1}/∂q_k has a real negative eigenvalue; −1: none
    tangent: Tensor  # (..., 2n+1, n) derivative of (q_N, p_N, s_N) by the parameters


def opening(
    P: Partials,  # order 2, of the N steps: entries (..., N, *)
    p: Tensor,  # (..., N, n) p_0 … p_{N−1}
    tangent: Tensor,  # (..., 2n+1, n) derivative of (q_0, p_0, s_0) by the parameters
) -> Opening:
    """Carry the tangent vectors of a family along its solution: Y_k = ∂q_k.

    With p_0 as the parameter Y_0 = 0 and a caustic is a conjugate point; with q_0 as the parameter (p_0 = dS(q_0))
    Y_0 = 1 and a caustic is where A + cα of the Riccati recursion is singular.
    """
    n = p.shape[-1]
    D = step_derivative(P, p)
    Y, current = [tangent[..., :n, :]], tangent
    for k in range(p.shape[-2]):
        current = D[..., k, :, :] @ current
        Y.append(current[..., :n, :])
    largest = torch.stack([torch.linalg.matrix_norm(y, ord="fro") for y in Y], -1).amax(-1)
    final = _singular_values(Y[-1])[..., -1] / largest
    crossed = torch.full_like(final, -1, dtype=torch.long)
    first = 0 if bool((tangent[..., :n, :] != 0).any()) else 1
    for k in reversed(range(first, p.shape[-2])):
        ratio = torch.linalg.solve_ex(Y[k].mT, Y[k + 1].mT)[0].mT  # ∂q_{k+1}/∂q_k along the family
        crossed = torch.where(_turns_over(ratio), k, crossed)
    return Opening(torch.nan_to_num(final, nan=0.0), crossed, current)


def _turns_over(ratio: Tensor) -> Tensor:
    """Whether a real eigenvalue is negative; complex pairs are no caustic."""
    finite = torch.isfinite(ratio).all(-1).all(-1)
    values = torch.linalg.eigvals(torch.where(finite[..., None, None], ratio, 0.0))
    real = values.imag.abs() <= torch.finfo(ratio.dtype).eps ** 0.5 * values.abs()
    return finite & (real & (values.real < 0)).any(-1)


def _singular_values(Y: Tensor) -> Tensor:
    finite = torch.isfinite(Y).all(-1).all(-1)
    return torch.linalg.svdvals(torch.where(finite[..., None, None], Y, 0.0))
