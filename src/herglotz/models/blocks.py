"""The blocks of `Partials` from the jet of L_d."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.mechanics import Forces, Partials
from herglotz.models.jet import Jet


def affine_partials(
    L: Jet,
    g: Tensor | Jet | None,
    c: Tensor | Jet | None,
    s0: Tensor,  # (...)
    force: Forces | None,
) -> Partials:
    """Return the blocks of an L_d that is affine in s0, from its jet over (q0, q1): D3 = c − 1 with c = e^g.

    A g of None means c = 1.
    """
    D3 = s0.new_zeros(()) if g is None else torch.expm1(g.value if isinstance(g, Jet) else g)
    D3 = D3.expand(s0.shape)
    gradient = L.gradient.movedim(0, -1)
    if L.order == 1:
        return _partials(L, gradient, D3, None, force)
    H = L.hessian().movedim((0, 1), (-2, -1))
    dc = c.gradient.movedim(0, -1) if isinstance(c, Jet) else torch.zeros_like(gradient)
    return _partials(L, gradient, D3, (H, dc, torch.zeros_like(D3)), force)


def action_partials(L: Jet) -> Partials:
    """Return the blocks of an L_d from its jet over the 2n + 1 variables (q0, q1, s0)."""
    gradient = L.gradient.movedim(0, -1)
    if L.order == 1:
        return _partials(L, gradient[..., :-1], gradient[..., -1], None)
    H = L.hessian().movedim((0, 1), (-2, -1))
    return _partials(L, gradient[..., :-1], gradient[..., -1], (H[..., :-1, :-1], H[..., :-1, -1], H[..., -1, -1]))


def _partials(
    L: Jet, by_q: Tensor, D3: Tensor, second: tuple[Tensor, Tensor, Tensor] | None, force: Forces | None = None
) -> Partials:
    """Return the blocks from ∂L/∂(q0, q1), D3, and `second`: (q0, q1) twice, mixed with s0, s0 twice."""
    n = by_q.shape[-1] // 2
    first = (L.value, by_q[..., :n], by_q[..., n:], D3)
    if second is None:
        return Partials(*first, force=force)
    H, mixed, D33 = second
    blocks = {"D11": H[..., :n, :n], "D12": H[..., :n, n:], "D22": H[..., n:, n:]}
    return Partials(*first, **blocks, D13=mixed[..., :n], D23=mixed[..., n:], D33=D33, force=force)
