"""The parts of a step in as few operations as they can be said: where each one costs, as in ONNX, the count decides.

With features y = (s, c) of a position, s = sin q, c = cos q = sin(q + π/2), one matrix turns y into its derivative
(c, −s), or the gradient in y by which that is multiplied. Coordinates that are no angles have s = q, and no c. A
layer's t = tanh z has t′ = 1 − t², so the reverse sweep through the last one, (w ∘ t′) W, is one affine map of t².

A step of constant c without drag has the equation, with κ = h/√c and m⁻¹ on the left,

    Δ = leap + e(Δ),    leap = h √c m⁻¹ (p0 − h/2 V0′),    e = κ m⁻¹ (D1 N + c h/2 f),

and e is small where corrections and forces are. `Attempt` iterates it (`herglotz.export.attempt`).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from herglotz.models import ContactLagrangian
from herglotz.models.network import Network
from herglotz.models.sweep import activation
from herglotz.models.terms import Kinetic, Potential
from herglotz.stepping.field import Field, FieldOf

FEW = 8  # rows of a matrix that a compiler had better multiply out


class Affine:
    """X W + b: one operation or, with `fused`, sums that a compiler makes one loop with what is around them.

    Sines and activations are multiplied as they are (`product`): a compiler would evaluate them again for every column.
    """

    def __init__(self, fused: bool):
        self.fused = fused

    def __call__(self, x: Tensor, W: Tensor, b: Tensor | None = None) -> Tensor:
        """X (B, k), W (k, m), b (m,) or (B, m)."""
        if not self.fused or len(W) > FEW:
            return x @ W if b is None else torch.addmm(b, x, W)
        terms = [x[:, i : i + 1] * W[i] for i in range(len(W))]
        return sum(terms[1:], terms[0]) if b is None else sum(terms, b)

    def product(self, x: Tensor, W: Tensor, b: Tensor) -> Tensor:
        """X W + b as one operation."""
        return torch.addmm(b, x, W)


class Features:
    """Y = (s, c) of positions and dy/dq, each (B, 2n)."""

    def __init__(self, angles: tuple[bool, ...], dtype: torch.dtype, affine: Affine):
        n = len(angles)
        self.affine = affine
        eye, mask = torch.eye(n, dtype=dtype), torch.tensor(angles, dtype=dtype)
        self.any, self.all = any(angles), all(angles)
        self.spread = torch.cat([eye, eye * mask], 1)  # q → (q, q)
        self.shift = torch.cat([0 * mask, mask * (math.pi / 2)])
        turn = torch.zeros(2 * n, 2 * n, dtype=dtype)
        turn[n:, :n], turn[:n, n:] = torch.diag(mask), -torch.diag(mask)
        self.turn, self.slope = turn, torch.cat([1 - mask, 0 * mask])
        self.mask = torch.cat([mask, mask]) > 0
        self.fold = torch.cat([eye, eye])  # (s, c) → their sum

    def phase(self, q: Tensor) -> Tensor:
        """What the sine is taken of."""
        return self.affine(q, self.spread, self.shift)

    def __call__(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Y, and what times `turned` of a gradient in y folds to the gradient in q: dy/dq, or y itself for angles."""
        if not self.any:
            return phase, self.slope.expand(phase.shape)
        y = phase.sin()
        if self.all:
            return y, y
        y = torch.where(self.mask, y, phase)
        return y, self.affine(y, self.turn, self.slope)

    def turned(self, g: Tensor) -> Tensor:
        """For angles g_s c − g_c s = (−g_c) s + g_s c: constants are turned, and y is not; (..., 2n)."""
        return g @ self.turn.T if self.all else g


def first_layer(network: Network, angles: tuple[bool, ...], scale: tuple[float, ...]) -> tuple[Tensor, Tensor]:
    """The first layer's weights as read by (s, c), transposed (2n, width), and by what follows the position."""
    weight = network.weights[0]
    n, sines, cosines, column = len(angles), [], [], 0
    for angle, size in zip(angles, scale, strict=True):
        sines.append(weight[:, column] / (1.0 if angle else size))
        cosines.append(weight[:, column + 1] if angle else torch.zeros_like(weight[:, column]))
        column += 2 if angle else 1
    assert len(sines) == n
    return torch.stack([*sines, *cosines]), weight[:, column:].T


class Tail:
    """A scalar network behind its first affine map, times a factor."""

    def __init__(self, network: Network, factor: float, affine: Affine):
        self.activation, self.affine = network.activation, affine
        weights = list(network.weights)
        self.weights, self.biases = weights[1:-1], list(network.biases)[1:]
        self.last = weights[-1][0] * factor

    def __call__(self, z: Tensor, *into: Tensor, base: Tensor | None = None) -> tuple[Tensor, list[Tensor]]:
        """The last hidden layer t, and ∂value/∂z times each of `into`, (width, k), plus `base`; z is (B, width)."""
        slopes: list[Tensor] = []
        depth = len(self.weights)
        t = z
        for i in range(depth + 1):
            if i:
                t = torch.addmm(self.biases[i - 1], t, self.weights[i - 1].T)
            t, f1, _ = activation(self.activation, t)
            slopes.append(f1)
        g = None
        for i in reversed(range(depth + 1)):
            targets = into if i == 0 else (self.weights[i - 1],)
            if self.affine.fused and len(targets) > 1:  # slices cost a compiler nothing
                targets = (torch.cat(targets, 1),)
            if g is None and self.activation == "tanh":  # (w ∘ (1 − t²)) W
                found = [self._folded(t * t, onto, base if i == 0 else None) for onto in targets]
            else:
                inner = slopes[i] * (self.last if g is None else g)
                found = [inner @ x if i or base is None else torch.addmm(base, inner, x) for x in targets]
            g = found[0]
        if len(found) < len(into):
            found = list(found[0].split([x.shape[1] for x in into], -1))
        return t, found  # pyright: ignore[reportPossiblyUnbound]  the loop runs at least once

    def _folded(self, squares: Tensor, onto: Tensor, base: Tensor | None) -> Tensor:
        constant = self.last @ onto if base is None else base + self.last @ onto
        return torch.addmm(constant, squares, -self.last[:, None] * onto)


class LeanField:
    """V, (B, 1), and V′, (B, n), of a potential with one network or none; others are evaluated as eager steps do."""

    def __init__(self, potential: Potential, fused: bool = False):
        self.whole = None if potential.features is None else FieldOf(potential)
        k, b = potential.stiffness, potential.tilt
        affine = self.affine = Affine(fused)
        self.features = Features(potential.angles, k.dtype, affine)
        self.angles = torch.tensor(potential.angles)
        self.quadratic = torch.where(self.angles, 0.0, k / 2)
        self.linear = torch.cat([b, -torch.where(self.angles, k, 0.0)])  # ∂/∂y of what is linear in y
        self.offset = torch.where(self.angles, k, 0.0).sum()
        self.stiffness = torch.where(self.angles, 0.0, k)
        self.tail = None
        if potential.network is not None:
            self.read, _ = first_layer(potential.network, potential.angles, potential.scale)
            self.bias = potential.network.biases[0]
            self.tail = Tail(potential.network, potential.energy, affine)

    def __call__(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """At q, (B, n)."""
        if self.whole is not None:
            V, slope = self.whole(q)
            return V[:, None], slope
        y, dy = self.features(self.features.phase(q))
        V, g = self.affine.product(y, self.linear[:, None], self.offset.reshape(1)), self.features.turned(self.linear)
        if self.tail is not None:
            z = self.affine.product(y, self.read, self.bias)
            t, (g,) = self.tail(z, self.features.turned(self.read.T), base=g)
            V = self.affine.product(t, self.tail.last[:, None], V)
        slope = self.affine(g * dy, self.features.fold)
        if not self.features.all:
            V, slope = self.affine(q * q, self.quadratic[:, None], V), torch.addcmul(slope, q, self.stiffness)
        return V, slope


class LeanEquation:
    """E(Δ) at (q0, p0, s0, h) for a model that `is_lean`; every number a sample is (B, 1).

    Parameters
    ----------
    model
        As `is_lean` accepts it.
    q, p, s, h
        (B, n), (B, n), (B, 1), (B, 1).
    V, slope
        (B, 1), (B, n): the potential at q.
    u
        (B, m) or None.
    fused
        As in `Affine`.
    """

    def __init__(
        self, model: ContactLagrangian, q: Tensor, p: Tensor, s: Tensor, h: Tensor, V: Tensor, slope: Tensor,
        u: Tensor | None, fused: bool = False,
    ):  # fmt: skip
        assert isinstance(model.kinetic, Kinetic)
        self.model, self.u = model, u
        affine = self.affine = Affine(fused)
        g = torch.zeros_like(h) if model.damping is None else model.damping(h, h, h, 1)
        root, c_minus_1 = (g / 2).exp(), torch.expm1(g)
        c = self.c = 1.0 + c_minus_1
        self.h, self.rate, self.half = h, 1 / h, h / 2
        self.kappa, self.half_c, stretch = h / root, c * self.half, h * root
        self.mass = model.kinetic.mass()
        self.inverse_mass = torch.linalg.inv_ex(self.mass)[0]
        a = p - self.half * slope
        self.push = c * a
        self.leap = affine(a, self.inverse_mass) * stretch
        self.before = c_minus_1 * s - self.half_c * V
        self.energy_rate = root / (h * h)
        self.N = model.correction
        if self.N is not None:
            net, config = self.N.network, model.config
            self.features = Features(config.angles, q.dtype, affine)
            self.read, velocity = first_layer(net, config.angles, config.scale)
            self.velocity = velocity / torch.tensor(config.speed, dtype=q.dtype)[:, None]
            self.bias, self.tail = net.biases[0], Tail(net, self.N.energy, affine)
            self.phase = self.features.phase(q)
        self.found: tuple[Tensor, ...] = ()

    def __call__(self, x: Tensor) -> Tensor:
        """E at Δ = x; what `gained` needs of it is kept."""
        total: Tensor | None = None
        v = x * self.rate
        if self.N is not None:
            y, dy = self.features(self.affine(x, self.features.spread / 2, self.phase))
            z = self.affine.product(y, self.read, self.affine(v, self.velocity, self.bias))
            t, g = self.tail(z, self.features.turned(self.read.T), -self.velocity.T @ self.inverse_mass)
            turned = g[0] * (dy * self.half)
            self.found = (t, turned)
            total = self.affine(turned, self.features.fold @ self.inverse_mass, g[1])
        if self.model.friction is not None:
            self.force = self.model.friction.value_and_slope(v, self.u)[0]
            pushed = self.affine(self.force, self.inverse_mass) * self.half_c
            total = pushed if total is None else total + pushed
        assert total is not None  # a model with neither steps in closed form
        return total * self.kappa

    def gained(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """p1, L and c at Δ = x without what V at q1 adds; networks are those of the last evaluation, beside it."""
        halves = torch.full_like(self.mass[:, :1], 0.5)
        kinetic = self.affine(x * self.affine(x, self.mass), halves) * self.energy_rate
        p1 = self.push
        if self.N is not None:
            t, turned = self.found
            kinetic = self.affine.product(t, self.tail.last[:, None], kinetic)
            p1 = self.affine(turned, 2 * self.features.fold, p1)  # D1 N + D2 N
        L = torch.addcmul(self.before, kinetic, self.h)
        if self.model.friction is not None:
            p1 = p1 + (self.half + self.half_c) * self.force
        return p1, L, self.c


def is_lean(model: ContactLagrangian) -> bool:
    """Whether `LeanEquation` knows the model: constant mass, c of h alone."""
    made_of = model.capabilities
    return made_of.by_terms and made_of.constant_c and not (made_of.explicit or made_of.position_features)


class FlatField:
    """A `LeanField` with V of shape (B,), in the place of `FieldOf`."""

    def __init__(self, field: LeanField):
        self.field = field

    def __call__(self, q: Tensor) -> Field:
        """At q, (B, n)."""
        V, slope = self.field(q)
        return Field(V[:, 0], slope)
