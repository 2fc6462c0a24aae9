"""Discrete gradients: ∇̄f(x0, x1) with ∇̄f·(x1 − x0) = f(x1) − f(x0), and ∇̄f(x, x) = ∇f(x).

With one of them, x1 = x0 + h B ∇̄H keeps H to round-off for every antisymmetric B. All three are batched and
differentiable; f maps (..., m) to (...).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from herglotz.theory.continuous import gradient

Function = Callable[[Tensor], Tensor]
DiscreteGradient = Callable[[Function, Tensor, Tensor], Tensor]


def midpoint_gradient(
    f: Function,
    x0: Tensor,  # (..., m)
    x1: Tensor,  # (..., m)
) -> Tensor:
    """∇f(x̄) + [f(x1) − f(x0) − ∇f(x̄)·Δ] Δ/|Δ|², x̄ = (x0 + x1)/2, Δ = x1 − x0; symmetric, shape (..., m).

    |Δ|² adds components of different units: a rescaled coordinate gives another gradient, of the same order.

    Source: O. Gonzalez, Time integration and discrete Hamiltonian systems, J. Nonlinear Sci. 6 (1996).
    """
    delta = x1 - x0
    _, g, _ = gradient(f, 0.5 * (x0 + x1))
    size = (delta * delta).sum(-1)
    # The bracket is O(|Δ|³): below this |Δ| it is under round-off, and the quotient would be noise.
    small = size <= _threshold(x0, 1 / 3) ** 2 * (1.0 + (x0 * x0).sum(-1))
    lack = (f(x1) - f(x0) - (g * delta).sum(-1)) / torch.where(small, 1.0, size)
    return g + torch.where(small, 0.0, lack)[..., None] * delta


def increment_gradient(
    f: Function,
    x0: Tensor,  # (..., m)
    x1: Tensor,  # (..., m)
) -> Tensor:
    """The mean of two coordinate-increment gradients, forward and backward in the order of coordinates; (..., m).

    One of them goes from x0 to x1 along the edges of a box, one coordinate at a time: ∇̄_i = [f(after) − f(before)]/Δ_i,
    an approximation of order 1; the mean with the same from x1 to x0 is symmetric and of order 2. Only values of f
    enter, except where a Δ_i is too small to divide by: there ∂_i f is averaged over the edge (two Gauss nodes).

    Source: T. Itoh, K. Abe, Hamiltonian-conserving discrete canonical equations based on variational difference
    quotients, J. Comput. Phys. 76 (1988).
    """
    return 0.5 * (_increments(f, x0, x1) + _increments(f, x1, x0))


def mean_value_gradient(
    f: Function,
    x0: Tensor,  # (..., m)
    x1: Tensor,  # (..., m)
    nodes: int = 6,
) -> Tensor:
    """∫₀¹ ∇f(x0 + tΔ) dt by Gauss quadrature; symmetric, of order 2, shape (..., m).

    No quotient, so no cancellation; f is kept up to the quadrature's error, O(|Δ|^{2·nodes+1}), and exactly for
    polynomials of degree 2·nodes.

    Source: A. Harten, P. Lax, B. van Leer, SIAM Rev. 25 (1983), mean-value form.
    """
    t, weight = _gauss(nodes, x0)
    x = x0[..., None, :] + t[:, None] * (x1 - x0)[..., None, :]
    return (weight[:, None] * gradient(f, x)[1]).sum(-2)


def _increments(f: Function, x0: Tensor, x1: Tensor) -> Tensor:
    """One coordinate-increment gradient, all edges of the box at once."""
    m = x0.shape[-1]
    taken = torch.ones(m + 1, m, dtype=torch.bool, device=x0.device).tril(-1)  # row i: coordinates before i are x1's
    corners = torch.where(taken, x1[..., None, :], x0[..., None, :])
    values = f(corners)
    delta = x1 - x0
    small = delta.abs() <= _threshold(x0, 1 / 4) * (1.0 + x0.abs())
    quotient = (values[..., 1:] - values[..., :-1]) / torch.where(small, 1.0, delta)
    t, weight = _gauss(2, x0)
    edges = corners[..., :-1, None, :] + t[:, None] * torch.diag_embed(delta)[..., None, :]  # (..., m, nodes, m)
    slopes = (weight[:, None] * gradient(f, edges)[1]).sum(-2).diagonal(dim1=-2, dim2=-1)
    return torch.where(small, slopes, quotient)


def _gauss(nodes: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Gauss–Legendre nodes and weights on [0, 1]."""
    t, weight = np.polynomial.legendre.leggauss(nodes)
    return torch.as_tensor(0.5 * (1.0 + t)).to(like), torch.as_tensor(0.5 * weight).to(like)


def _threshold(x: Tensor, power: float) -> float:
    return torch.finfo(x.dtype).eps ** power
