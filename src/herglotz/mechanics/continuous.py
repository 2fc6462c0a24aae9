"""The continuous counterpart: contact Hamiltonian H(q, p, s) and its vector field."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Hamiltonian = Callable[[Tensor, Tensor, Tensor], Tensor]


def contact_vector_field(
    H: Hamiltonian,
    q: Tensor,  # (..., n)
    p: Tensor,  # (..., n)
    s: Tensor,  # (...)
) -> tuple[Tensor, Tensor, Tensor]:
    """X_H: q̇ = H_p, ṗ = −(H_q + p H_s), ṡ = p·H_p − H.

    Returns
    -------
    tuple of Tensor
        (q̇, ṗ, ṡ) with shapes (..., n), (..., n), (...).

    Source: contact Hamilton equations of the paper.
    """
    with torch.enable_grad():
        q, p, s = (x.detach().requires_grad_() for x in (q, p, s))
        value = H(q, p, s)
        H_q, H_p, H_s = torch.autograd.grad(value.sum(), (q, p, s), materialize_grads=True, allow_unused=True)
    return H_p, -(H_q + p.detach() * H_s[..., None]), (p.detach() * H_p).sum(-1) - value.detach()
