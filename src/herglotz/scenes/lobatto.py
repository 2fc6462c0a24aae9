"""Polynomials through Gauss–Lobatto nodes on [0, 1]: their integrals, and their values in between."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from torch import Tensor

Array = np.ndarray


@cache
def lobatto(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """The nodes c_i, the matrix a_ij = ∫_0^{c_i} l_j (the quadrature is its last row), and the values on finer nodes.

    Legendre's series of l_j is exact and loses no digits with many nodes, as powers of x would.

    Parameters
    ----------
    count
        k nodes, k ≥ 3; both ends are nodes, and the middle of an odd number.

    Returns
    -------
    tuple of Tensor
        (k,), (k, k) and (2k − 1, k), float64.
    """
    last = np.polynomial.legendre.Legendre.basis(count - 1)
    x = np.concatenate([[-1.0], np.sort(last.deriv().roots().real), [1.0]])
    x = 0.5 * (x - x[::-1])
    inner = x[1:-1]
    for _ in range(3):  # the roots come from eigenvalues; Newton's method has their last digits
        inner = inner - last.deriv()(inner) / last.deriv(2)(inner)
    x[1:-1] = inner
    degrees = np.arange(count)
    P = np.polynomial.legendre.legvander(x, count)
    norm = 2 / (2 * degrees + 1)  # of P_k; that of the last is of no account, as its integral is 0 at every node
    weights = 2 / (count * (count - 1) * P[:, count - 1] ** 2)
    series = (P[:, :-1] * weights[:, None] / norm).T  # (degree, j) coefficients of l_j
    integral = np.empty((count, count))  # (i, degree) of P_k from −1 to x_i
    integral[:, 0] = x + 1
    integral[:, 1:] = (P[:, 2:] - P[:, :-2]) / (2 * degrees[1:] + 1)
    integral[0] = 0.0
    if count % 2 == 0 or count > MOST:
        finer = np.zeros((0, count))
    else:
        finer = _values(x, np.sqrt(weights), 2 * lobatto(2 * count - 1)[0].numpy() - 1)
    return torch.from_numpy((x + 1) / 2), torch.from_numpy(integral @ series / 2), torch.from_numpy(finer)


def _values(nodes: Array, size: Array, x: Array) -> Array:
    """l_j(x) by the barycentric formula, whose weights are ± the roots of the quadrature's."""
    apart = x[:, None] - nodes
    hit = np.abs(apart) < 1e-15
    terms = size * (-1.0) ** np.arange(len(nodes)) / np.where(hit, 1.0, apart)
    return np.where(hit.any(1, keepdims=True), hit, terms / terms.sum(1, keepdims=True))


MOST = 65  # nodes that have finer ones
