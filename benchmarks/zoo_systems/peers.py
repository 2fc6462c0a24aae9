"""Peers in the zoo: SINDy, and the true structure with its numbers fitted.

SINDy is a sparse regression of smoothed accelerations on a library of polynomials and trigonometric terms. Local
polynomials of degree 4 give position, velocity and acceleration; sequentially thresholded least squares selects. The
width of the smoothing and the threshold are chosen by free runs over the last fifth of the training part.

The true structure is the best that a few-number model of the right equation can reach: Levenberg–Marquardt on whole
training recordings over the numbers and the start states, from the true numbers; RK4 with implicit dry friction,
Jacobian by differences, all columns stepped as one batch.

Source: S. L. Brunton, J. L. Proctor and J. N. Kutz, PNAS 113 (2016) 3932.
"""

from __future__ import annotations

import numpy as np

from benchmarks.peers.samples import local_polynomials
from benchmarks.zoo_systems.mechanisms import Array, Mechanism, rk4
from benchmarks.zoo_systems.prediction import SMOOTH, MechanismModel, roll, start_states, trained
from benchmarks.zoo_systems.systems import ZooSystem

HALF_WIDTHS = (0.02, 0.05, 0.1, 0.2)  # of the smoothing window, in natural periods; two samples at the least
THRESHOLDS = (0.0, 0.003, 0.01, 0.03, 0.1)  # of a term's share in the acceleration, relative to its RMS
RIDGE, ROUNDS = 1e-8, 10
RECORDED = 0.2  # of the training part, to choose by


class SparseModel:
    """q̈ = Θ(q, q̇, u) ξ."""

    def __init__(self, coefficients: Array, angles: tuple[bool, ...]):
        self.coefficients, self.angles = coefficients, angles

    def advance(self, q: Array, v: Array, u: Array, h: float) -> tuple[Array, Array]:
        """One recorded step by RK4."""
        count = int(np.ceil(h / SMOOTH - 1e-9))
        for _ in range(count):
            q, v = rk4(lambda q, v: library(q, v, u, self.angles) @ self.coefficients, q, v, h / count)
        return q, v


def library(q: Array, v: Array, u: Array, angles: tuple[bool, ...]) -> Array:
    """Candidate terms, (…, T)."""
    n = q.shape[-1]
    x, y = [q[..., i] for i in range(n)], [v[..., i] for i in range(n)]
    terms = [np.ones_like(u), u, *x, *y]
    for i in range(n):
        terms += [y[i] * np.abs(y[i]), np.sign(y[i]), x[i] ** 2 * y[i]]
        terms += [np.sin(x[i]), np.cos(x[i]), np.sin(2 * x[i])] if angles[i] else []
        for j in range(i, n):
            terms += [x[i] * x[j], y[i] * y[j]]
            if j > i:
                apart = x[i] - x[j]
                terms += [np.sin(apart), apart**3, y[i] ** 2 * np.sin(apart), y[j] ** 2 * np.sin(apart)]
                terms += [y[j] ** 2 * np.sin(x[j]), np.sin(2 * x[j])]
        terms.append(x[i] ** 3)
    return np.stack(terms, -1)


def fit_sindy(of: ZooSystem) -> SparseModel:
    """The model whose free runs over the last part of the training samples are nearest."""
    m, angles = trained(of.train), of.mechanism.angles
    kept = int(m * (1 - RECORDED))
    models: list[tuple[float, int, SparseModel]] = []
    for half in sorted({max(2, round(w * of.samples_per_period)) for w in HALF_WIDTHS}):
        if 2 * half + 1 > kept // 2:
            continue
        at = np.arange(half, m - half)
        rows = [local_polynomials(of.train.t[:m], q[:m], at, half, 4) for q in of.train.q]
        x, y, a = (np.concatenate([row[i] for row in rows]) for i in range(3))
        terms = library(x, y, np.concatenate([u[half : m - half] for u in of.train.u]), angles)
        for threshold in THRESHOLDS:
            model = SparseModel(_thresholded(terms, a, threshold), angles)
            models.append((_held_out(of, model, kept, m), len(models), model))
    return min(models)[2]


def _thresholded(terms: Array, a: Array, threshold: float) -> Array:
    """Sequentially thresholded least squares for each coordinate, (T, n)."""
    scale = np.sqrt(np.mean(terms**2, 0)) + 1e-300
    found = np.zeros((terms.shape[1], a.shape[1]))
    for i in range(a.shape[1]):
        active = scale > 1e-12
        for _ in range(ROUNDS):
            X = terms[:, active] / scale[active]
            c = np.linalg.solve(X.T @ X + RIDGE * len(X) * np.eye(X.shape[1]), X.T @ a[:, i])
            found[:, i] = 0.0
            found[active, i] = c / scale[active]
            small = np.abs(found[:, i] * scale) < threshold * np.sqrt(np.mean(a[:, i] ** 2))
            if not (small & active).any() or not (active & ~small).any():
                break
            active &= ~small
    return found


def _held_out(of: ZooSystem, model: SparseModel, kept: int, m: int) -> float:
    """Error over the noise of free runs from sample `kept` to the end of the training part; infinite if one is lost."""
    first = max(0, kept - of.warmup)
    t, q, u = of.train.t[first:m], of.train.q[:, first:m], of.train.u[:, first:m]
    warm, n = kept - first, q.shape[-1]
    x = start_states(model, t[:warm], q[:, :warm], u[:, :warm], of.floor, iterations=5)
    error = (roll(model, x[:, :n], x[:, n:], t, u) - q)[:, warm:] / of.floor
    return float(np.nan_to_num(np.sqrt(np.mean(error**2)), nan=np.inf))


ITERATIONS = 20  # from the true numbers; a gain below 1e-5 of the cost ends the fit before
TRIALS = 8  # of an iteration, each 30 times more damped: where a joint sticks the slopes hold over a short way only
OFFSET = 1e-5  # of finite differences, relative to 1 for numbers of the mechanism, to the noise for states


def fit_known(of: ZooSystem) -> MechanismModel:
    """The mechanism with its numbers fitted to the training part."""
    m = trained(of.train)
    t, q, u = of.train.t[:m], of.train.q[:, :m], of.train.u[:, :m]
    B, _, n = q.shape
    names = list(of.mechanism.values)
    theta = np.array([float(of.mechanism.values[name]) for name in names])
    x = start_states(MechanismModel(of.mechanism), t, q, u, of.floor)

    def residual(theta: Array, x: Array) -> Array:
        """(C, P) and (C, B, 2n) → (C, B, K·n)."""
        C = len(theta)
        values = {name: np.repeat(theta[:, i], B) for i, name in enumerate(names)}
        model = MechanismModel(Mechanism(of.mechanism.kind, n, values))
        flat = x.reshape(C * B, 2 * n)
        out = roll(model, flat[:, :n], flat[:, n:], t, np.tile(u, (C, 1)))
        return ((out - np.tile(q, (C, 1, 1))) / of.floor).reshape(C, B, -1)

    r, damping, P = residual(theta[None], x[None])[0], 1e-6, len(names)
    if not np.isfinite(r).all():
        return MechanismModel(of.mechanism)
    for _ in range(ITERATIONS):
        step = np.concatenate([np.full(P, OFFSET), OFFSET * np.tile(of.floor, 2)])
        columns = np.eye(P + 2 * n) * step
        moved = residual(theta + columns[:, :P], x + columns[:, None, P:])
        J = np.moveaxis(np.nan_to_num((moved - r) / step[:, None, None]), 0, -1)  # (B, K·n, P + 2n)
        A, g = _normal_equations(J, r, P)
        for _ in range(TRIALS):
            d = np.linalg.solve(A + damping * np.diag(np.diag(A)) + 1e-12 * np.eye(len(A)), g)
            trial, start = theta - d[:P], x - d[P:].reshape(B, 2 * n)
            new = residual(trial[None], start[None])[0]
            if np.isfinite(new).all() and np.square(new).sum() < np.square(r).sum():
                gain = 1 - np.square(new).sum() / np.square(r).sum()
                theta, x, r, damping = trial, start, new, damping / 10
                break
            damping *= 30
        else:
            break
        if gain < 1e-5:
            break
    return MechanismModel(of.mechanism.with_values(**dict(zip(names, map(float, theta), strict=True))))


def _normal_equations(J: Array, r: Array, P: int) -> tuple[Array, Array]:
    """Shared numbers first, then the start state of each recording."""
    B, _, width = J.shape
    d = width - P
    A, g = np.zeros((P + B * d, P + B * d)), np.zeros(P + B * d)
    for b in range(B):
        at = np.concatenate([np.arange(P), P + b * d + np.arange(d)])
        A[np.ix_(at, at)] += J[b].T @ J[b]
        g[at] += J[b].T @ r[b]
    return A, g
