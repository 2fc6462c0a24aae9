"""A scalar network by one forward and one reverse sweep: the cheap twin of its jets, for the iterations of a step.

The step equation needs the gradient of a network of (q̄, v) and the derivative of the gradient along q1; a rollout needs
V and V′. A reverse sweep gives the gradient at the cost of the value, and tangents through both sweeps give the second
derivative: 1 + n rows in place of the 1 + 2n + n(2n + 1) rows of a jet over (q0, q1).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import linear, logsigmoid

from herglotz.cached import cached
from herglotz.models.network import Network


class Trigonometry(NamedTuple):
    """The entries of features, each (..., n): sin q and cos q of angles, q itself of other coordinates."""

    s: Tensor  # (..., n) sin q, or q
    c: Tensor  # (..., n) cos q
    ds: Tensor  # (..., n) ∂s/∂q: cos q, or 1
    minus_sin: Tensor  # (..., n) ∂c/∂q


@cached
def _angle_mask(angles: tuple[bool, ...], device: torch.device) -> Tensor | None:
    """(n,) whether each coordinate is an angle; None if all are."""
    return None if all(angles) else torch.tensor(angles, device=device)


def trigonometry(q: Tensor, angles: tuple[bool, ...]) -> Trigonometry:
    """The trigonometry of q, (..., n)."""
    sin, cos = q.sin(), q.cos()
    mask = _angle_mask(angles, q.device)
    if mask is None:
        return Trigonometry(sin, cos, cos, -sin)
    return Trigonometry(torch.where(mask, sin, q), cos, torch.where(mask, cos, 1.0), -sin)


class Sweep:
    """A scalar network as a function of (s, c) or (s, c, v), the `Trigonometry` of q and the velocity.

    The network reads the features of `Phase`, or those of `position_features` if `speed` is None; `scale` and `speed`
    are folded into the weights of the first layer, which stay as they are now. `factor`, a number or a tensor (...)
    such as h, multiplies the network.
    """

    def __init__(
        self,
        network: Network,
        angles: tuple[bool, ...],
        scale: tuple[float, ...],
        speed: tuple[float, ...] | None,
        factor: float | Tensor,
    ):
        weights = network.layers
        index, fold = _columns(angles, scale, speed, weights[0].dtype, weights[0].device)
        self.hidden = [weights[0] if index is None else weights[0][:, index] * fold, *weights[1:-1]]
        self.biases = list(network.biases)
        self.activation = network.activation
        if isinstance(factor, Tensor):
            factor = factor[..., None]
        self.last = weights[-1][0] * factor  # (width,) or (..., width)

    def __call__(self, y: Tensor, dy: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor | None]:
        """Value (...), gradient (..., m) at the features y (..., m), and the gradient's tangents (k, ..., m).

        Without the tangents dy of y, (k, ..., m), the third result is None.
        """
        layers: list[tuple[Tensor, Tensor | None]] = []
        for weight, bias in zip(self.hidden, self.biases, strict=True):
            y, f1, f2 = activation(self.activation, linear(y, weight, bias), second=dy is not None)
            if dy is None:
                layers.append((f1, None))
            else:
                dz = linear(dy, weight) if not layers else linear(dy * layers[-1][0], weight)
                layers.append((f1, f2 * dz))
                dy = dz
        last = self.last
        value = y @ last if last.ndim == 1 else (y * last).sum(-1)
        g, dg = last, None
        for weight, (f1, turned) in zip(reversed(self.hidden), reversed(layers), strict=True):
            if turned is not None:
                dg = (g * turned if dg is None else torch.addcmul(dg * f1, turned, g)) @ weight
            g = (g * f1) @ weight
        return value, g, dg


@cached
def _columns(
    angles: tuple[bool, ...],
    scale: tuple[float, ...],
    speed: tuple[float, ...] | None,
    dtype: torch.dtype,
    device: torch.device,
) -> tuple[Tensor | None, Tensor]:
    """The columns of the first layer that read s, c and v, and their factors; None if the columns need no change.

    A coordinate that is no angle has no cosine: its factor is 0.
    """
    sines, cosines, factors, column = [], [], [], 0
    for angle in angles:
        sines.append(column)
        cosines.append(column + 1 if angle else column)
        factors.append(1.0 if angle else 0.0)
        column += 2 if angle else 1
    fold = [1.0 if a else 1.0 / x for a, x in zip(angles, scale, strict=True)] + factors
    index = sines + cosines
    if speed is not None:
        index += range(column, column + len(angles))
        fold += [1.0 / v for v in speed]
    plain = index == list(range(len(index))) and all(x == 1.0 for x in fold)
    return None if plain else torch.tensor(index, device=device), torch.tensor(fold, dtype=dtype, device=device)


@cached
def numbers(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """The tensors 0 and 1."""
    return torch.zeros((), dtype=dtype, device=device), torch.ones((), dtype=dtype, device=device)


def activation(name: str, z: Tensor, *, second: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """The activation and its first two derivatives; without `second` the first stands for the second."""
    if name == "tanh":
        t, (zero, one) = z.tanh(), numbers(z.dtype, z.device)
        # 1 − t² and −2 t f′ in one operation each, without the conversion of a Python number.
        f1 = torch.addcmul(one, t, t, value=-1)
        return t, f1, torch.addcmul(zero, t, f1, value=-2) if second else f1
    up, down = z.sigmoid(), (-z).sigmoid()
    if name == "softplus":
        return -logsigmoid(-z), up, up * down if second else up
    f1 = up * (1.0 + z * down)
    return z * up, f1, up * down * (2.0 + z * (down - up)) if second else f1
