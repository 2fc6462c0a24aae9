"""Equations of motion of the zoo: M(q) v̇ = f(q, v, u) − dry friction, each kind with a few named numbers.

Everything is batched: q and v are (B, n), u is (B,), and a number of a mechanism is a float or (B,), so that one call
evaluates as many parameter sets as a finite-difference Jacobian needs. Units are natural: mass, length and frequency 1.

Motions are as exact as the zoo needs them: RK4 in fine steps, dry friction by events. Dry friction makes each
coordinate slip forwards, slip backwards or stick. In a mode the motion is smooth; a step in which a slipping speed
changes sign is cut where the speed is zero (bisection), and the coordinate then sticks where the other forces are
within the static level. Inputs are held over a recorded step, which is a whole number of fine steps. A fine step of
1/500 of the natural period leaves an error of about 1e-9 of the amplitude.
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

    Those of coordinate i end in i: `d` viscous, `a` quadratic, `c` dry friction, `e` and `w` the excess and the width
    of Stribeck friction c + e exp(−(v/w)²), `z` drag z (q² − 1) v, `o` a constant force; `b` is the gain of the input,
    which acts on coordinate 0.
    """

    # "spring" (polynomial potential), "pendulum" (trigonometric potential), "axis" (no potential), "chain" (masses
    # between two walls), "pendulums" (coupled by torsion), "double_pendulum" or "cart_pole".
    kind: str
    n: int  # number of coordinates
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


FINE = 2 * np.pi / 500  # longest fine step, in natural units
BISECTIONS = 50  # of the time of an event, in a fine step


def exact_motion(
    of: Mechanism,
    q0: Array,  # (B, n)
    v0: Array,  # (B, n)
    t: Array,  # (N,) times, shared by the batch, increasing
    u: Array,  # (B, N) input of the step that starts at each time
) -> tuple[Array, Array]:
    """Positions and velocities at the times t, (B, N, n) each."""
    q, v = q0.copy(), v0.copy()
    mode = _modes(of, q, v, u[:, 0], np.sign(v))
    qs, vs = [q], [v]
    for k in range(len(t) - 1):
        count = int(np.ceil((t[k + 1] - t[k]) / FINE))
        h = (t[k + 1] - t[k]) / count
        for _ in range(count):
            if of.has_dry_friction:
                mode = _modes(of, q, v, u[:, k], mode)
            q, v, mode = _fine_step(of, q, v, u[:, k], h, mode)
        qs.append(q)
        vs.append(v)
    return np.stack(qs, 1), np.stack(vs, 1)


def _fine_step(of: Mechanism, q: Array, v: Array, u: Array, h: float, mode: Array) -> tuple[Array, Array, Array]:
    """One fine step of all motions; those whose slip reverses in it are stepped again, one by one."""
    q1, v1 = _rk4(of, q, v, u, h, mode)
    if not of.has_dry_friction:
        return q1, v1, mode
    mode1 = mode.copy()
    for b in ((mode * v1) < 0).any(-1).nonzero()[0]:
        own = slice(b, b + 1)
        q1[own], v1[own], mode1[own] = _with_events(of, q[own], v[own], u[own], h, mode[own])
    return q1, v1, mode1


def _with_events(of: Mechanism, q: Array, v: Array, u: Array, h: float, mode: Array) -> tuple[Array, Array, Array]:
    """A fine step of one motion, cut at each reversal of a slip."""
    for _ in range(20):
        q1, v1 = _rk4(of, q, v, u, h, mode)
        if not (mode * v1 < 0).any():
            return q1, v1, mode
        low, high = 0.0, h
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if (mode * _rk4(of, q, v, u, middle, mode)[1] < 0).any() else (middle, high)
        q, v = _rk4(of, q, v, u, high, mode)
        reversed_ = mode * v < 0
        v = np.where(reversed_, 0.0, v)
        mode = _modes(of, q, v, u, np.where(reversed_, 0.0, mode))
        h -= high
        if h <= 0:
            return q, v, mode
    raise RuntimeError("more than 20 reversals in a fine step")


def _modes(of: Mechanism, q: Array, v: Array, u: Array, mode: Array) -> Array:
    """+1 and −1: slip; 0: stick, and everywhere without dry friction.

    A coordinate at rest starts to slip where the other forces exceed the static level. Dry friction stands on constant
    diagonal masses only, so each coordinate is decided on its own.
    """
    static = of.dry_level(np.zeros_like(v))
    f = of.smooth_force(q, v, u)
    starts = np.where(np.abs(f) > static, np.sign(f), 0.0)
    return np.where(static > 0, np.where((mode == 0) | (v == 0), starts, mode), 0.0)


def _rk4(of: Mechanism, q: Array, v: Array, u: Array, h: float, mode: Array) -> tuple[Array, Array]:
    """One step of the smooth motion in a mode; a coordinate that sticks has the speed 0."""
    dry = of.has_dry_friction
    stuck = (mode == 0) & (of.dry_level(np.zeros_like(v)) > 0) if dry else False

    def slope(q: Array, v: Array) -> Array:
        f = of.smooth_force(q, v, u)
        return np.where(stuck, 0.0, of.acceleration(q, f - mode * of.dry_level(v) if dry else f))

    return rk4(slope, q, v, h)
