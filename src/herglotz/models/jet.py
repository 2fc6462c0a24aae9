"""Second-order jets: a function's value, gradient and Hessian carried together, in closed form.

A jet holds f, ∂_i f and ∂_i ∂_j f (i ≤ j) along d tangent directions as rows of one tensor of shape
(1 + d + d(d+1)/2, ...), so that a network layer is a single matrix product. Sums, products, `exp`, `sin`, … follow the
product and chain rules, and a Lagrangian written in jets reads like its formula:

    L = (c - 1) * (s0 - h / 2 * V0) + K - h / 2 * (V0 + V1)

At order 1 the Hessian rows are absent, at order 0 there are no tangent directions. Every operation is an ordinary torch
operation, so autograd and vmap apply.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import linear, logsigmoid

from herglotz.cached import cached

Constant = Tensor | float


@cached
def pairs(d: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Indices (i, j) with i ≤ j of the Hessian rows, in their order."""
    i, j = torch.triu_indices(d, d, device=device)
    return i, j


@cached
def _unpack_index(d: int, device: torch.device) -> Tensor:
    """(d, d) the row number of ∂_i ∂_j f among the Hessian rows."""
    i, j = pairs(d, device)
    index = torch.zeros(d, d, dtype=torch.long, device=device)
    index[i, j] = index[j, i] = torch.arange(len(i), device=device)
    return index


@cached
def _upper_index(d: int, device: torch.device) -> Tensor:
    """Indices of ∂_i ∂_j f, i ≤ j, in the flattened (d, d) matrix: ONNX takes entries along one axis."""
    i, j = pairs(d, device)
    return d * i + j


@cached
def _embed_index(d: int, size: int, offset: int, order: int, device: torch.device) -> Tensor:
    """Row numbers that place a jet over d tangents in a jet over `size`; the last row (zeros) fills the rest."""
    slot = {offset + k: k for k in range(d)}
    unpack = _unpack_index(d, torch.device("cpu")).tolist()
    zero = 1 + d + (d * (d + 1) // 2 if order == 2 else 0)
    rows = [0] + [1 + slot[i] if i in slot else zero for i in range(size)]
    if order == 2:
        for i, j in zip(*(x.tolist() for x in pairs(size, torch.device("cpu"))), strict=True):
            rows.append(1 + d + unpack[slot[i]][slot[j]] if i in slot and j in slot else zero)
    return torch.tensor(rows, device=device)


class Jet:
    """Value, gradient and (order 2) Hessian of a function of d variables."""

    __slots__ = ("_parts", "data", "order", "tangents")

    def __init__(self, data: Tensor, tangents: int, order: int):
        self.data = data  # (rows, ...)
        self.tangents = tangents
        self.order = order
        self._parts: tuple[Tensor, ...] | None = None

    def _split(self) -> tuple[Tensor, ...]:
        """The rows of f, its gradient and its Hessian, split once so that the backward pass joins them once."""
        if self._parts is None:
            d = self.tangents
            self._parts = self.data.split([1, d, len(self.data) - 1 - d])
        return self._parts

    @property
    def value(self) -> Tensor:
        """f, shape (...)."""
        return self._split()[0][0]

    @property
    def gradient(self) -> Tensor:
        """∂_i f, shape (d, ...)."""
        return self._split()[1]

    def hessian(self) -> Tensor:
        """∂_i ∂_j f, shape (d, d, ...)."""
        return self.second[_unpack_index(self.tangents, self.data.device)]

    @property
    def second(self) -> Tensor:
        """∂_i ∂_j f for i ≤ j, shape (d(d+1)/2, ...)."""
        return self._split()[2]

    def _with(self, *rows: Tensor) -> Jet:
        return Jet(torch.cat(rows), self.tangents, self.order)

    def map(self, f0: Tensor, f1: Tensor, f2: Tensor | None) -> Jet:
        """Chain rule for f(self), given f, f′ and, at order 2, f″ at the value."""
        if not self.order:
            return self._with(f0[None])
        g = self.gradient
        if f2 is None or self.order == 1:
            return self._with(f0[None], f1 * g)
        i, j = pairs(self.tangents, self.data.device)
        return self._with(f0[None], f1 * g, f1 * self.second + f2 * (g[i] * g[j]))

    def exp(self) -> Jet:
        """e^f."""
        e = self.value.exp()
        return self.map(e, e, e)

    def expm1(self) -> Jet:
        """e^f − 1, accurate for small f."""
        e = self.value.exp()
        return self.map(self.value.expm1(), e, e)

    def tanh(self) -> Jet:
        """The hyperbolic tangent: f′ = 1 − t², f″ = −2 t f′."""
        t = self.value.tanh()
        f1 = 1 - t * t
        return self.map(t, f1, -2 * t * f1)

    def softplus(self) -> Jet:
        """log(1 + e^f): f′ is the logistic function σ, f″ = σ(1 − σ); 1 − σ(f) = σ(−f) does not cancel."""
        x = self.value
        up = x.sigmoid()
        return self.map(-logsigmoid(-x), up, up * (-x).sigmoid())

    def silu(self) -> Jet:
        """The product f σ(f), with σ the logistic function."""
        x = self.value
        up, down = x.sigmoid(), (-x).sigmoid()
        return self.map(x * up, up * (1 + x * down), up * down * (2 + x * (down - up)))

    def sin(self) -> Jet:
        """Sin f."""
        s, c = self.value.sin(), self.value.cos()
        return self.map(s, c, -s)

    def cos(self) -> Jet:
        """Cos f."""
        s, c = self.value.sin(), self.value.cos()
        return self.map(c, -s, -c)

    def linear(self, weight: Tensor, bias: Tensor | None = None) -> Jet:
        """W f + b on the last axis, for a vector-valued jet."""
        out = linear(self.data, weight)
        return Jet(out, self.tangents, self.order) if bias is None else self._with((out[0] + bias)[None], out[1:])

    def select(self, index: int | slice | Tensor) -> Jet:
        """Components of a vector-valued jet."""
        return Jet(self.data[..., index], self.tangents, self.order)

    def sum(self) -> Jet:
        """Sum over the last axis."""
        return Jet(self.data.sum(-1), self.tangents, self.order)

    def __add__(self, other: Jet | Constant) -> Jet:
        if isinstance(other, Jet):
            return Jet(self.data + other.data, self.tangents, self.order)
        return self._with((self.value + other)[None], self.data[1:])

    def __neg__(self) -> Jet:
        return Jet(-self.data, self.tangents, self.order)

    def __sub__(self, other: Jet | Constant) -> Jet:
        return self + (-other)

    def __rsub__(self, other: Constant) -> Jet:
        return -self + other

    def __mul__(self, other: Jet | Constant) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.data * other, self.tangents, self.order)
        a, b, ga, gb = self.value, other.value, self.gradient, other.gradient
        first = a * gb + b * ga
        if self.order < 2:
            return self._with((a * b)[None], first)
        i, j = pairs(self.tangents, self.data.device)
        second = a * other.second + b * self.second + ga[i] * gb[j] + ga[j] * gb[i]
        return self._with((a * b)[None], first, second)

    def __truediv__(self, other: Constant) -> Jet:
        return Jet(self.data / other, self.tangents, self.order)

    __radd__ = __add__
    __rmul__ = __mul__

    def embed(self, size: int, offset: int) -> Jet:
        """The same function as a jet over `size` variables, of which its own start at `offset`."""
        index = _embed_index(self.tangents, size, offset, self.order, self.data.device)
        rows = torch.cat([self.data, torch.zeros_like(self.data[:1])])
        return Jet(rows[index], size, self.order)


def of_mean(jet: Jet) -> Jet:
    """A function of q̄ = (q0 + q1)/2, given as a jet over the n components of q̄, as a jet over (q0, q1)."""
    n, half = jet.tangents, jet.gradient / 2
    rows = [jet.value[None], half, half]
    if jet.order == 2:
        i, j = pairs(2 * n, jet.data.device)
        rows.append(jet.second[_unpack_index(n, jet.data.device)[i % n, j % n]] / 4)
    return Jet(torch.cat(rows), 2 * n, jet.order)


def of_mean_and_velocity(
    value: Tensor,  # (...)
    by_q: Tensor,  # (n, ...)
    by_v: Tensor,  # (n, ...)
    second: tuple[Tensor, Tensor, Tensor] | None,
    h: Tensor,  # (...)
) -> Jet:
    """A function of q̄ = (q0 + q1)/2 and v = (q1 − q0)/h as a jet over (q0, q1), from its derivatives by q̄ and v.

    `second` holds the rows ∂q_i ∂q_j for i ≤ j, the matrix ∂v_i ∂q_j (n, n, ...), and the rows ∂v_i ∂v_j for i ≤ j.
    """
    n, half, slope = len(by_q), by_q / 2, by_v / h
    rows = [value[None], half - slope, half + slope]
    if second is not None:
        unpack = _unpack_index(n, value.device)
        qq, vv, vq = second[0][unpack] / 4, second[2][unpack] / (h * h), second[1] / (2 * h)
        qv = vq.transpose(0, 1)
        same, mixed, across = qq + vv, vq + qv, qq - vv + qv - vq
        H = torch.cat([torch.cat([same - mixed, across], 1), torch.cat([across.transpose(0, 1), same + mixed], 1)])
        rows.append(H.flatten(0, 1)[_upper_index(2 * n, value.device)])
    return Jet(torch.cat(rows), 2 * n, 1 if second is None else 2)


def coordinates(q: Tensor, order: int) -> Jet:
    """The identity q ↦ q as a vector-valued jet over its own n components; q is (..., n)."""
    n = q.shape[-1]
    return affine(q, torch.eye(n, dtype=q.dtype, device=q.device), order)


def affine(value: Tensor, slope: Tensor, order: int) -> Jet:
    """A vector-valued jet (..., m) with constant gradient: slope (d, m) or (d, ..., m) is ∂_i of each component."""
    slope = slope if order else slope[:0]
    d = slope.shape[0]
    slope = slope.reshape(d, *(1,) * (value.ndim - slope.ndim + 1), *slope.shape[1:])
    rows = [value[None], slope.expand(d, *value.shape)]
    if order == 2:
        rows.append(torch.zeros_like(value).expand(d * (d + 1) // 2, *value.shape))
    return Jet(torch.cat(rows), d, order)


def concatenate(jets: list[Jet]) -> Jet:
    """Join vector-valued jets along the last axis."""
    return Jet(torch.cat([j.data for j in jets], -1), jets[0].tangents, jets[0].order)
