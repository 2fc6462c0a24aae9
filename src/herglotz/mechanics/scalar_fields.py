"""Derivatives of a function f(q, x, s) or F(x): a contact Hamiltonian, a continuous Lagrangian, a function on Q.

All functions are batched over leading dimensions. A result can be differentiated again where an argument wants a
gradient.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from herglotz.mechanics.partials import Partials, autograd_partials

ScalarField = Callable[[Tensor, Tensor, Tensor], Tensor]
Hamiltonian = ScalarField
Lagrangian = ScalarField


def derivatives(
    f: ScalarField,
    q: Tensor,  # (..., n)
    x: Tensor,  # (..., n) p or v
    s: Tensor,  # (...)
    order: int = 1,
) -> Partials:
    """f(q, x, s) and its derivatives: D1 = f_q, D2 = f_x, D3 = f_s, D12 = f_qx and so on."""
    return autograd_partials(lambda q, x, s, h: f(q, x, s), q, x, s, 0.0, order)  # noqa: ARG005


def gradient(
    F: Callable[[Tensor], Tensor],  # (..., m) → (...)
    x: Tensor,  # (..., m)
    order: int = 1,
) -> tuple[Tensor, Tensor, Tensor]:
    """F, F_x and (order 2) F_xx with shapes (...), (..., m), (..., m, m)."""
    P = autograd_partials(lambda x, _, s, h: F(x), x, x, x[..., 0], 0.0, order)  # noqa: ARG005
    return P.L, P.D1, P.D11


def square_jacobian(
    # (..., m) → (..., k); f must treat the samples independently and accept one more leading dimension
    f: Callable[[Tensor], Tensor],
    x: Tensor,  # (..., m)
    rows: int | None = None,  # () k, m by default
) -> tuple[Tensor, Tensor]:
    """f(x) and its Jacobian, as `contact.jacobian`, by one backward pass instead of k.

    f is evaluated on k copies of x; the gradient of component i on copy i is row i of the Jacobian.
    """
    copies = x.expand(x.shape[-1] if rows is None else rows, *x.shape)
    y, J, _ = gradient(lambda x: f(x).diagonal(dim1=0, dim2=-1).movedim(-1, 0), copies)
    return y.movedim(0, -1), J.movedim(0, -2)
