"""The contact form η = ds − p·dq, its pull-back by a map, and the derivative of a map.

Tangent vectors of (q, p, s) are ordered q₁…q_n, p₁…p_n, s, so a map's derivative is a (2n+1, 2n+1) matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

from herglotz.errors import InputError

Triple = tuple[Tensor, Tensor, Tensor]
Flow = Callable[[Tensor, Tensor, Tensor], Triple]


def join(q: Tensor, p: Tensor, s: Tensor) -> Tensor:
    """(q, p, s) as one tensor (..., 2n+1)."""
    return torch.cat([q, p, s[..., None]], -1)


def split(x: Tensor) -> Triple:
    """(q, p, s) from one tensor (..., 2n+1), the inverse of `join`."""
    n = x.shape[-1] // 2
    return x[..., :n], x[..., n : 2 * n], x[..., 2 * n]


def normal(x: Tensor) -> Tensor:
    """x, or a copy of an x of inference mode, by which autograd cannot differentiate."""
    if not x.is_inference():
        return x
    with torch.inference_mode(False):
        return x.clone()


def contact_form(p: Tensor) -> Tensor:
    """Components (−p, 0, 1) of η = ds − p·dq at a point with momentum p (..., n); (..., 2n+1)."""
    return torch.cat([-p, torch.zeros_like(p), torch.ones_like(p[..., :1])], -1)


def flow_derivative(flow: Flow, q: Tensor, p: Tensor, s: Tensor) -> tuple[Triple, Tensor]:
    """Value (q1, p1, s1) and derivative DΦ (..., 2n+1, 2n+1) of a map Φ of (q, p, s), by autograd, batched."""
    return flow_derivatives([flow], q, p, s)[0]


def flow_derivatives(
    flows: Iterable[Flow],  # (Φ_1, Φ_2, …)
    q: Tensor,
    p: Tensor,
    s: Tensor,
) -> list[tuple[Triple, Tensor]]:
    """Value and derivative of Φ_1, Φ_2∘Φ_1, … as `flow_derivative` returns them; every map is evaluated once."""
    found = []
    with torch.inference_mode(False), torch.enable_grad():
        x = join(normal(q), normal(p), normal(s)).detach().requires_grad_()
        q, p, s = split(x)
        for flow in flows:
            q, p, s = flow(q, p, s)
            found.append(((q.detach(), p.detach(), s.detach()), *rows_of(join(q, p, s), (x,), create_graph=False)))
    return found


def jacobian(
    f: Callable[[Tensor], Tensor],  # (..., m) → (..., k), sample by sample
    x: Tensor,  # (..., m)
) -> tuple[Tensor, Tensor]:
    """f(x) and ∂f/∂x, (..., k) and (..., k, m); with a graph if x or a parameter of f requires a gradient.

    One x may serve all samples of f.
    """
    keep_graph = torch.is_grad_enabled() and (x.requires_grad or f(x).requires_grad)
    with torch.inference_mode(False), torch.enable_grad():
        x = x * 1 if keep_graph and x.requires_grad else normal(x).detach().requires_grad_()
        y = f(x)
        batch = torch.broadcast_shapes(y.shape[:-1], x.shape[:-1])
        if batch != x.shape[:-1]:
            # Rows by an x that several samples share would be sums over these.
            x = x.expand(*batch, x.shape[-1])
            y = f(x)
        (J,) = rows_of(y, (x,), keep_graph)
    return (y, J) if keep_graph else (y.detach(), J)


def rows_of(y: Tensor, xs: tuple[Tensor, ...], create_graph: bool) -> tuple[Tensor, ...]:
    """∂y/∂x for each x: (..., m, n) for x (..., n), (..., m) for x (...); the m components of y in one backward pass.

    Rows are computed one by one where a batch of them cannot be: by a custom backward pass that reads numbers, and in a
    trace, which refuses the writes through views by which a batched slice is differentiated.
    """
    m, batch = y.shape[-1], y.ndim - 1
    found: tuple[Tensor | None, ...] = (None,) * len(xs)
    if y.requires_grad:
        options = {"create_graph": create_graph, "retain_graph": True, "allow_unused": True}
        unit = torch.eye(m, dtype=y.dtype, device=y.device).reshape(m, *(1,) * batch, m).expand(m, *y.shape)
        try:
            found = torch.autograd.grad(y, xs, unit, is_grads_batched=True, **options)
        except (RuntimeError, InputError):
            one_by_one = zip(*(torch.autograd.grad(y, xs, row, **options) for row in unit), strict=True)
            found = tuple(None if rows[0] is None else torch.stack(rows) for rows in one_by_one)
    rows = (x.new_zeros(m, *x.shape) if g is None else g for g, x in zip(found, xs, strict=True))
    return tuple(g.movedim(0, batch) for g in rows)


def contact_defect(
    derivative: Tensor,  # (..., 2n+1, 2n+1) DΦ
    p0: Tensor,  # (..., n)
    p1: Tensor,  # (..., n)
    c: Tensor,  # (...)
) -> Tensor:
    """DΦᵀ η(x1) − c η(x0), shape (..., 2n+1): zero for a contact map with conformal factor c."""
    pulled_back = (derivative.mT @ contact_form(p1)[..., None])[..., 0]
    return pulled_back - c[..., None] * contact_form(p0)
