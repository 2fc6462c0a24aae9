"""From the jet of L_d to the blocks of `Partials`."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.mechanics import Forces, Partials
from herglotz.models.jet import Jet


def affine_partials(
    L: Jet,  # over the 2n components of (q0, q1)
    g: Tensor | Jet | None,  # the exponent of c; None: c = 1
    c: Tensor | Jet | None,
    s0: Tensor,  # (...)
    force: Forces | None,
) -> Partials:
    """Return the blocks of an L_d that is affine in s0: D3 = c − 1."""
    n = L.tangents // 2
    gradient = L.gradient.movedim(0, -1)
    D3 = s0.new_zeros(()) if g is None else torch.expm1(g.value if isinstance(g, Jet) else g)
    D3 = D3.expand(s0.shape)
    D1, D2 = gradient[..., :n], gradient[..., n:]
    if L.order == 1:
        return Partials(L.value, D1, D2, D3, force=force)
    H = L.hessian().movedim((0, 1), (-2, -1))
    dc = c.gradient.movedim(0, -1) if isinstance(c, Jet) else torch.zeros_like(gradient)
    return Partials(
        L.value,
        D1,
        D2,
        D3,
        D11=H[..., :n, :n],
        D12=H[..., :n, n:],
        D22=H[..., n:, n:],
        D13=dc[..., :n],
        D23=dc[..., n:],
        D33=torch.zeros_like(D3),
        force=force,
    )


def action_partials(L: Jet) -> Partials:
    """Return the blocks of an L that is a jet over the 2n + 1 variables (q0, q1, s0)."""
    n = L.tangents // 2
    gradient = L.gradient.movedim(0, -1)
    D1, D2, D3 = gradient[..., :n], gradient[..., n:-1], gradient[..., -1]
    if L.order == 1:
        return Partials(L.value, D1, D2, D3)
    H = L.hessian().movedim((0, 1), (-2, -1))
    return Partials(
        L.value,
        D1,
        D2,
        D3,
        D11=H[..., :n, :n],
        D12=H[..., :n, n:-1],
        D22=H[..., n:-1, n:-1],
        D13=H[..., :n, -1],
        D23=H[..., n:-1, -1],
        D33=H[..., -1, -1],
    )
