"""The derivatives of L_d by `torch.func`, where autograd cannot go: inside `vmap`, Jacobians by parameters, traces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from torch import Tensor
from torch.func import vjp

from herglotz.mechanics.contact import split
from herglotz.mechanics.partials import DiscreteLagrangian, Forced, Forces, Partials, called, checked, second_blocks


def functional_partials(
    L_d: DiscreteLagrangian,
    q0: Tensor,  # (..., n)
    q1: Tensor,  # (..., n)
    s0: Tensor,  # (...)
    h: Tensor,  # () or (...)
    order: int = 1,
) -> Partials:
    """Return the result of `autograd_partials` by function transforms, which nest: (...) may be a sample in `vmap`.

    Samples do not interact, so one product with the Jacobian of the batch is the batch of gradients. The second
    derivatives are 2n + 1 products with the Jacobian of the gradients. L_d must be a pure function of tensors.
    """
    q0, q1, s, steps = torch.broadcast_tensors(q0, q1, s0[..., None], h[..., None])
    xs, h = (q0, q1, s[..., 0]), steps[..., 0]

    def first(*x: Tensor) -> tuple[Tensor, Tensor]:
        L, pull = cast(Any, vjp(lambda q0, q1, s: checked(L_d, called(L_d, q0, q1, s, h), s), *x))
        D1, D2, D3 = pull(torch.ones_like(L))
        return torch.cat([D1, D2, D3[..., None]], -1), L

    force = _forces(L_d, xs, h, order) if isinstance(L_d, Forced) else None
    if order == 1:
        D, L = first(*xs)
        return Partials(L, *split(D), force=force)
    D, by, L = _rows(first, xs)
    return Partials(L, *split(D), **second_blocks(*by), force=force)


def _rows(function: Callable[..., tuple[Tensor, Any]], xs: tuple[Tensor, ...]) -> tuple[Tensor, list[Tensor], Any]:
    """The value y (..., m), ∂y/∂x of every x (..., m, *), and the function's second result."""
    y, pull, rest = cast(Any, vjp(function, *xs, has_aux=True))
    units = torch.eye(y.shape[-1], dtype=y.dtype, device=y.device)
    rows = [pull(unit.expand(y.shape)) for unit in units.unbind()]
    return y, [torch.stack(x, y.ndim - 1) for x in zip(*rows, strict=True)], rest


def _forces(L_d: Forced, xs: tuple[Tensor, Tensor, Tensor], h: Tensor, order: int) -> Forces | None:
    """F⁻ and F⁺, with their derivatives at order 2."""
    found = L_d.forces(*xs, h)
    if found is None or order == 1:
        return None if found is None else Forces(*found)

    # The second result is an empty tuple: torch.func accepts no None there.
    def both(*x: Tensor) -> tuple[Tensor, tuple[()]]:
        return torch.cat(cast(Any, L_d).forces(*x, h), -1), ()

    n = xs[0].shape[-1]
    F, by, _ = _rows(both, xs)
    minus = F[..., :n], *(x.narrow(F.ndim - 1, 0, n) for x in by)
    plus = F[..., n:], *(x.narrow(F.ndim - 1, n, n) for x in by)
    return Forces(minus[0], plus[0], *minus[1:], *plus[1:])
