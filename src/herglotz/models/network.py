"""A small multilayer perceptron with derivatives by closed-form jets, and its input features."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from herglotz.models.jet import Jet, affine, concatenate

# Methods of `Jet`. All are smooth: a Hessian of 0 would make the step equation singular (trap 6).
ACTIVATIONS = ("tanh", "softplus", "silu")


class Network(nn.Module):
    """Perceptron R^m → R (or R^k) with a zero-initialised last layer, so that a new model equals its baseline.

    Parameters
    ----------
    sizes
        m, then the hidden units of each layer.
    gain
        Size of the initial weights relative to 1/√inputs; below 1 the network starts smooth.
    generator
        Generator of the initial weights.
    zero
        False draws the last layer too, for a model without a baseline.
    outputs
        Number k of outputs; None: a scalar.
    activation
        One of `ACTIVATIONS`.
    """

    def __init__(
        self,
        sizes: Sequence[int],
        gain: float,
        generator: torch.Generator,
        *,
        zero: bool = True,
        outputs: int | None = None,
        activation: str = "tanh",
    ):
        super().__init__()
        self.activation, self.scalar = activation, outputs is None
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for a, b in pairwise(sizes):
            weight, bias = (torch.randn(b, k, generator=generator, dtype=torch.float64) for k in (a, 1))
            self.weights.append(nn.Parameter(weight * (gain / a**0.5)))
            self.biases.append(nn.Parameter(bias[:, 0] * gain))
        last = torch.zeros(outputs or 1, sizes[-1], dtype=torch.float64)
        if not zero:
            last = torch.randn(outputs or 1, sizes[-1], generator=generator, dtype=torch.float64) / sizes[-1] ** 0.5
        self.weights.append(nn.Parameter(last))
        # A projection (m, m) of the features, along whose null space the network is constant; None: no projection.
        # `models/translations.py` sets the projection for an imposed symmetry.
        self.projection: Tensor | None
        self.register_buffer("projection", None, persistent=False)

    @property
    def layers(self) -> list[Tensor]:
        """The weights; the first layer reads the features through `projection`, if there is one."""
        first, *rest = self.weights
        return [first if self.projection is None else first @ self.projection, *rest]

    def forward(self, x: Jet) -> Jet:
        """Apply the network to a jet of features (..., m); the result is a scalar jet, or (..., k)."""
        *hidden, last = self.layers
        for weight, bias in zip(hidden, self.biases, strict=True):
            x = getattr(x.linear(weight, bias), self.activation)()
        return x.linear(last).select(0) if self.scalar else x.linear(last)


def position_features(q: Jet, angles: tuple[bool, ...], scale: tuple[float, ...]) -> Jet:
    """Return (sin q, cos q) of every angle and q / scale of every other coordinate."""
    columns = []
    for i, angle in enumerate(angles):
        x = q.select(slice(i, i + 1))
        columns += [x.sin(), x.cos()] if angle else [x / scale[i]]
    return concatenate(columns)


def feature_count(angles: tuple[bool, ...]) -> int:
    """Return the number of features that `position_features` makes."""
    return sum(2 if angle else 1 for angle in angles)


def midpoint_velocity_jets(
    q0: Tensor, q1: Tensor, h: Tensor, order: int, delta: Tensor | None = None
) -> tuple[Jet, Jet]:
    """Return q̄ = (q0 + q1)/2 and v = Δ/h as jets over the 2n components of (q0, q1); Δ defaults to q1 − q0."""
    n = q0.shape[-1]
    eye = torch.eye(n, dtype=q0.dtype, device=q0.device)
    shape = q0.shape[:-1]
    # `broadcast_shapes` takes 0.1 ms of a step's 10 ms.
    shape = shape if shape == h.shape else torch.broadcast_shapes(shape, h.shape)
    q0, q1 = q0.expand(*shape, n), q1.expand(*shape, n)
    rate = 1 / h.expand(shape)[..., None]  # (..., 1)
    eye_v = eye.reshape(n, *(1,) * len(shape), n) * rate  # (n, ..., n)
    mean = affine((q0 + q1) / 2, torch.cat([eye, eye]) / 2, order)
    velocity = affine((q1 - q0 if delta is None else delta) * rate, torch.cat([-eye_v, eye_v]), order)
    return mean, velocity
