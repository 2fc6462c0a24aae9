"""Free runs of an equation of motion, from a start state that is read from a warm-up by least squares."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from benchmarks.zoo_systems.mechanisms import Array, Mechanism, rk4
from benchmarks.zoo_systems.systems import TRAIN, Recording, ZooSystem

SMOOTH, DRY = 2 * np.pi / 60, 2 * np.pi / 250  # longest inner step, natural units; dry friction is split, of order 2
LOST = 1e6  # a motion beyond this has diverged


class EquationModel(Protocol):
    """Anything that steps positions and velocities over a recorded step with a held input."""

    def advance(self, q: Array, v: Array, u: Array, h: float) -> tuple[Array, Array]:
        """(B, n), (B, n), (B,) → (B, n), (B, n)."""
        ...


class MechanismModel:
    """A mechanism stepped by RK4; dry friction takes its impulse before and after, and never reverses a speed."""

    def __init__(self, of: Mechanism):
        self.of = of

    def advance(self, q: Array, v: Array, u: Array, h: float) -> tuple[Array, Array]:
        """One recorded step."""
        of, dry = self.of, self.of.has_dry_friction
        count = int(np.ceil(h / (DRY if dry else SMOOTH) - 1e-9))
        h = h / count
        slope = lambda q, v: of.acceleration(q, of.smooth_force(q, v, u))  # noqa: E731
        for _ in range(count):
            if dry:
                v = self._rubbed(q, v, h / 2)
            q, v = rk4(slope, q, v, h)
            if dry:
                v = self._rubbed(q, v, h / 2)
        return q, v

    def _rubbed(self, q: Array, v: Array, h: float) -> Array:
        return np.sign(v) * np.maximum(np.abs(v) - h * self.of.dry_level(v) / self.of.mass(q), 0.0)


def roll(model: EquationModel, q: Array, v: Array, t: Array, u: Array) -> Array:
    """Positions at the times t, (B, N, n); NaN once a motion has diverged."""
    out = [q]
    with np.errstate(all="ignore"):
        for k in range(len(t) - 1):
            q, v = model.advance(q, v, u[:, k], t[k + 1] - t[k])
            lost = ~(np.abs(q).max(-1) + np.abs(v).max(-1) < LOST)
            q, v = (np.where(lost[:, None], np.nan, x) for x in (q, v))
            out.append(q)
    return np.stack(out, 1)


def start_states(model: EquationModel, t: Array, q: Array, u: Array, weight: Array, iterations: int = 12) -> Array:
    """(B, 2n) states at t[0] from which the model passes the samples q (B, K, n) nearest, by Levenberg–Marquardt."""
    B, n = len(q), q.shape[-1]
    x = _first_guess(t, q)
    offsets = 1e-6 * np.tile(weight, 2)  # of finite differences
    damping = np.full(B, 1e-6)
    residual = _misfit(model, x, t, q, u, weight)
    for _ in range(iterations):
        moved = np.concatenate([x + offsets * row for row in np.eye(2 * n)])
        tiled = [np.tile(y, (2 * n, *(1,) * (y.ndim - 1))) for y in (q, u)]
        shifted = _misfit(model, moved, t, *tiled, weight).reshape(2 * n, B, -1)
        J = np.moveaxis((shifted - residual) / offsets[:, None, None], 0, -1)  # (B, K·n, 2n)
        J, r = np.nan_to_num(J, posinf=0.0, neginf=0.0), np.nan_to_num(residual, posinf=0.0)
        A, g = np.einsum("bki,bkj->bij", J, J), np.einsum("bki,bk->bi", J, r)
        diagonal = np.einsum("bii->bi", A).copy()
        A += np.einsum("b,bi,ij->bij", damping, diagonal + 1e-12, np.eye(2 * n)) + 1e-12 * np.eye(2 * n)
        trial = x - np.linalg.solve(A, g[..., None])[..., 0]
        new = _misfit(model, trial, t, q, u, weight)
        better = _cost(new) < _cost(residual)
        x, residual = np.where(better[:, None], trial, x), np.where(better[:, None], new, residual)
        damping = np.where(better, damping / 10, damping * 30)
    return x


def own_predictions(of: ZooSystem, model: EquationModel) -> dict[str, tuple[Array, Array]]:
    """(prediction, data) on the unseen third of the training recordings and on the unseen starts, each (…, n)."""
    found = {}
    first = trained(of.train)
    for name, data, at in (("later", of.train, first - of.warmup), ("unseen", of.test, 0)):
        at = max(at, 0)
        warm = slice(at, (first if name == "later" else of.warmup))
        x = start_states(model, data.t[warm], data.q[:, warm], data.u[:, warm], of.floor)
        n = data.q.shape[-1]
        q = roll(model, x[:, :n], x[:, n:], data.t[at:], data.u[:, at:])
        free = warm.stop - at
        found[name] = q[:, free:].reshape(-1, n), data.q[:, warm.stop :].reshape(-1, n)
    return found


def trained(data: Recording) -> int:
    """Samples of each recording that are trained on, as `fit` rounds them."""
    return round(TRAIN * data.q.shape[1])


def _first_guess(t: Array, q: Array) -> Array:
    """Position and slope at t[0] of a parabola through the first samples."""
    some = max(4, min(len(t), len(t) // 4))
    A = np.stack([np.ones(some), t[:some] - t[0], (t[:some] - t[0]) ** 2], -1)
    c = np.einsum("ik,bkn->bin", np.linalg.pinv(A), q[:, :some])
    return np.concatenate([c[:, 0], c[:, 1]], -1)


def _misfit(model: EquationModel, x: Array, t: Array, q: Array, u: Array, weight: Array) -> Array:
    n = q.shape[-1]
    out = roll(model, x[:, :n], x[:, n:], t, u)
    return ((out - q) / weight).reshape(len(x), -1)


def _cost(r: Array) -> Array:
    return np.nan_to_num(np.square(r).sum(-1), nan=np.inf)
