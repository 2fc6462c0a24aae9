"""Equations of motion of the zoo: M(q) v̇ = f(q, v, u) − dry friction, each kind with a few named numbers.

Everything is batched: q and v are (B, n), u is (B,), and a number of a mechanism is a float or (B,), so that one call
evaluates as many parameter sets as a finite-difference Jacobian needs. Units are natural: mass, length and frequency 1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Values = dict[str, float | Array]

ANGLES = {"spring": False, "axis": False, "chain": False, "pendulum": True, "pendulums": True, "double_pendulum": True}


@dataclass(frozen=True)
class Mechanism:
    """A kind of mechanism with its numbers.

    Parameters
    ----------
    kind
        "spring" (polynomial potential), "pendulum" (trigonometric potential), "axis" (no potential), "chain" (masses
        between two walls), "pendulums" (coupled by torsion), "double_pendulum" or "cart_pole".
    n
        Number of coordinates.
    values
        Numbers by name; those of coordinate i end in i. `d` viscous, `a` quadratic, `c` dry friction, `e` and `w` the
        excess and the width of Stribeck friction c + e exp(−(v/w)²), `z` drag z (q² − 1) v, `o` a constant force,
        `b` the gain of the input, which acts on coordinate 0.
    """

    kind: str
    n: int
    values: Values

    @property
    def angles(self) -> tuple[bool, ...]:
        """Which coordinates are angles."""
        return (False, True) if self.kind == "cart_pole" else (ANGLES[self.kind],) * self.n

    @property
    def coupled_mass(self) -> bool:
        """Whether the mass matrix depends on position."""
        return self.kind in ("double_pendulum", "cart_pole")

    @property
    def has_dry_friction(self) -> bool:
        """Whether any coordinate has dry friction."""
        return any(name[0] in "ce" for name in self.values)

    def __getitem__(self, name: str) -> float | Array:
        return self.values.get(name, 0.0)

    def with_values(self, **values: float | Array) -> Mechanism:
        """The mechanism with some numbers changed."""
        return replace(self, values={**self.values, **values})

    def mass(self, q: Array) -> Array:
        """(B, n) of a constant diagonal mass, (B, n, n) of one that depends on position."""
        if not self.coupled_mass:
            return np.stack([self._spread(f"m{i}", q, 1.0) for i in range(self.n)], -1)
        M = np.empty((*q.shape, self.n))
        m, r = self._spread("m", q, 1.0), self._spread("r", q, 1.0)
        if self.kind == "cart_pole":  # cart and pole weigh 1 together, the pole m; r from the hinge to its centre
            M[..., 0, 0], M[..., 1, 1] = 1.0, m * r * r
            M[..., 0, 1] = M[..., 1, 0] = m * r * np.cos(q[..., 1])
        else:  # first mass and length 1, second m and r; both angles from the vertical
            M[..., 0, 0], M[..., 1, 1] = 1.0 + m, m * r * r
            M[..., 0, 1] = M[..., 1, 0] = m * r * np.cos(q[..., 0] - q[..., 1])
        return M

    def smooth_force(self, q: Array, v: Array, u: Array) -> Array:
        """Generalised force without dry friction, (B, n)."""
        f = getattr(self, f"_{self.kind}")(q, v)
        for i in range(self.n):
            x, y = q[..., i], v[..., i]
            drag = self[f"d{i}"] + self[f"a{i}"] * np.abs(y) + self[f"z{i}"] * (x * x - 1.0)
            f[..., i] += self[f"o{i}"] - drag * y
        f[..., 0] += self["b"] * u
        return f

    def dry_level(self, v: Array) -> Array:
        """Magnitude of dry friction at these speeds, (B, n)."""
        rows = []
        for i in range(self.n):
            excess = self[f"e{i}"] * np.exp(-((v[..., i] / self.values.get(f"w{i}", 1.0)) ** 2))
            rows.append(np.broadcast_to(self[f"c{i}"] + excess, v.shape[:-1]))
        return np.stack(rows, -1)

    def acceleration(self, q: Array, force: Array) -> Array:
        """M⁻¹ f, (B, n)."""
        M = self.mass(q)
        return np.linalg.solve(M, force[..., None])[..., 0] if self.coupled_mass else force / M

    def _spread(self, name: str, q: Array, default: float) -> Array:
        return np.broadcast_to(np.asarray(self.values.get(name, default), dtype=float), q.shape[:-1])

    def _axis(self, q: Array, v: Array) -> Array:  # noqa: ARG002
        return np.zeros_like(q)

    def _spring(self, q: Array, v: Array) -> Array:  # noqa: ARG002
        x = q[..., 0]
        return -(x * (self["k"] + x * (self["k2"] + x * self["k3"])))[..., None]

    def _pendulum(self, q: Array, v: Array) -> Array:  # noqa: ARG002
        x = q[..., 0]
        return -(self["g"] * np.sin(x) + self["g2"] * np.sin(2 * x))[..., None]

    def _chain(self, q: Array, v: Array) -> Array:  # noqa: ARG002
        wall = np.zeros((*q.shape[:-1], 1))
        stretch = np.diff(np.concatenate([wall, q, wall], -1))
        tension = np.stack(
            [(self[f"k{j}"] + self["k3"] * stretch[..., j] ** 2) * stretch[..., j] for j in range(self.n + 1)], -1
        )
        return np.diff(tension)

    def _pendulums(self, q: Array, v: Array) -> Array:  # noqa: ARG002
        f = np.stack([-self[f"g{i}"] * np.sin(q[..., i]) for i in range(self.n)], -1)
        for i in range(self.n - 1):
            twist = self["k"] * np.sin(q[..., i] - q[..., i + 1])
            f[..., i] -= twist
            f[..., i + 1] += twist
        return f

    def _double_pendulum(self, q: Array, v: Array) -> Array:
        m, r, g = self["m"], self["r"], self["g"]
        twist = m * r * np.sin(q[..., 0] - q[..., 1])
        first = -twist * v[..., 1] ** 2 - (1.0 + m) * g * np.sin(q[..., 0])
        second = twist * v[..., 0] ** 2 - m * r * g * np.sin(q[..., 1])
        return np.stack([first, second], -1)

    def _cart_pole(self, q: Array, v: Array) -> Array:
        m, r, g = self["m"], self["r"], self["g"]
        cart = m * r * np.sin(q[..., 1]) * v[..., 1] ** 2 - self["k"] * q[..., 0]
        return np.stack([cart, -m * r * g * np.sin(q[..., 1])], -1)


def rk4(slope: Callable[[Array, Array], Array], q: Array, v: Array, h: float) -> tuple[Array, Array]:
    """One Runge–Kutta step of q̈ = slope(q, q̇)."""
    a1 = slope(q, v)
    v2 = v + 0.5 * h * a1
    a2 = slope(q + 0.5 * h * v, v2)
    v3 = v + 0.5 * h * a2
    a3 = slope(q + 0.5 * h * v2, v3)
    v4 = v + h * a3
    a4 = slope(q + h * v3, v4)
    return q + h / 6 * (v + 2 * v2 + 2 * v3 + v4), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
