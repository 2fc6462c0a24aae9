"""The true equation with its numbers fitted: the best that a model of the right structure can reach.

Levenberg–Marquardt on whole training recordings over the numbers and the start states, from the true numbers; RK4 with
implicit dry friction, Jacobian by differences, all columns stepped as one batch.
"""

from __future__ import annotations

import numpy as np

from benchmarks.zoo_systems.mechanisms import Array, Mechanism
from benchmarks.zoo_systems.prediction import MechanismModel, roll, start_states, trained
from benchmarks.zoo_systems.systems import ZooSystem

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
