"""Motions of a mechanism as exact as the zoo needs them: RK4 in fine steps, dry friction by events.

Dry friction makes each coordinate slip forwards, slip backwards or stick. In a mode the motion is smooth; a step in
which a slipping speed changes sign is cut where the speed is zero (bisection), and the coordinate then sticks where the
other forces are within the static level. Inputs are held over a recorded step, which is a whole number of fine steps.
A fine step of 1/500 of the natural period leaves an error of about 1e-9 of the amplitude.
"""

from __future__ import annotations

import numpy as np

from benchmarks.zoo_systems.mechanisms import Array, Mechanism, rk4

FINE = 2 * np.pi / 500  # longest fine step, in natural units
BISECTIONS = 50  # of the time of an event, in a fine step


def exact_motion(of: Mechanism, q0: Array, v0: Array, t: Array, u: Array) -> tuple[Array, Array]:
    """Positions and velocities at the times t.

    Parameters
    ----------
    of
        The mechanism.
    q0, v0
        (B, n) initial states.
    t
        (N,) times, shared by the batch, increasing.
    u
        (B, N) input of the step that starts at each time.

    Returns
    -------
    tuple of ndarray
        (B, N, n) twice.
    """
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
