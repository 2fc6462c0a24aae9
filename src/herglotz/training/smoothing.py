"""`smooth`: the states behind noisy positions, given a model: every state an unknown, steps with a little noise.

Minimises, over the states X_k = (q, p[, s]) at all nodes of a trajectory,

    ½ Σ |q_k − q_data|²/σ² + ½ Σ |(Φ̃(X_k) − X_{k+1})/w|²,

by Gauss–Newton. The matrix is block tridiagonal: the cost grows with the number of samples, not with its cube. This is
the fixed-interval smoother of Rauch, Tung & Striebel (1965), iterated for a nonlinear step (Bell 1994). w > 0 lets the
motion leave the model a little at every step, so that a push, or a force the model does not know, is followed.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.checks import check_positive
from herglotz.data.trajectories import GAP
from herglotz.errors import InputError
from herglotz.mechanics import legendre_minus, partials
from herglotz.models import ContactLagrangian
from herglotz.stepping import State
from herglotz.stepping.block_tridiagonal import solve_blocks
from herglotz.training.flat import FixedModel, FlatModel
from herglotz.training.grid import segment_grid
from herglotz.training.inputs import step_inputs
from herglotz.training.lifted import all_steps

ITERATIONS, HALVINGS = 30, 12


@dataclass(frozen=True)
class Smoothed:
    """States at every sample and their standard errors, given the model."""

    states: State  # (N, n), (N, n), (N,)
    std: State  # the same shapes; s has 0 where the motion does not depend on it


def smooth(model: ContactLagrangian, data: Trajectories, sigma: float, *, process: float = 0.1) -> Smoothed:
    """Smoothed states of each trajectory.

    Parameters
    ----------
    model
        The dynamics; its parameters are held.
    data
        Positions, and inputs where the model takes them; steps may differ, samples may be missing.
    sigma
        Standard deviation of the noise of q, in its units.
    process
        Standard deviation of what a step leaves of the model, relative to sigma: w = process · sigma in q, and the same
        share of the natural size in p and s. Small: the model is believed; large: the data are.

    Raises
    ------
    InputError
        If sigma or process is not positive, or a step has no solution near the data.
    """
    check_positive("sigma", sigma)
    check_positive("process", process)
    data = data.unwrapped()
    flat, n = FlatModel(model), data.dof
    d = 2 * n + (1 if model.s_enters_motion else 0)
    q, std = data.q.new_zeros(data.samples, 2 * n + 1), data.q.new_zeros(data.samples, 2 * n + 1)
    scale, speed = (data.q.new_tensor(x) for x in (model.config.scale, model.config.speed))
    sizes = torch.cat([torch.ones_like(scale), speed / scale, (speed * scale).sum()[None] / scale.max()])[:d]
    for b, first in enumerate(data.offsets):
        one = data[b]
        with torch.no_grad():
            x, variance, node = _trajectory(flat, model, one, sigma, process * sigma * sizes, d)
        rows = slice(first, first + one.samples)
        q[rows, : x.shape[1]], std[rows, :d] = x[node], variance.clamp_min(0).sqrt()[node]
    return Smoothed(*(State(y[:, :n], y[:, n : 2 * n], y[:, 2 * n]) for y in (q, std)))


def _trajectory(
    flat: FlatModel, model: ContactLagrangian, data: Trajectories, sigma: float, w: Tensor, d: int
) -> tuple[Tensor, Tensor, Tensor]:
    """States (K+1, 2n+1) of one trajectory, variances (K+1, d), and the node of every sample."""
    grid, u = segment_grid(data, data.samples, GAP * data.typical_step), step_inputs(model, data)
    L_d = flat.at(flat.get(), None if u is None else u[grid.row])
    h, n, where = grid.h, data.dof, data.source or "data"
    node = grid.node[grid.sample.argsort()]
    x = _guess(L_d, data, h, node)
    precision = 1 / w.square()
    observed = torch.zeros_like(x[:, :d])
    observed[node, :n] = 1 / sigma**2
    target = torch.zeros_like(x[:, :d])
    target[node, :n] = data.q

    def cost_of(x: Tensor, y: Tensor) -> Tensor:
        miss, defect = x[:, :d] - target, y[:, :d] - x[1:, :d]
        return ((observed * miss.square()).sum() + (precision * defect.square()).sum()) / 2

    stepped = all_steps(L_d, x[None], h)
    if stepped is None:
        raise InputError(f"{where}: the model has no step near these data, so nothing can be smoothed; fit it again")
    cost = cost_of(x, stepped[0][0])
    blocks = None
    for _ in range(ITERATIONS):
        y, A = stepped[0][0], stepped[1][0, :, :d, :d]
        WA = precision[:, None] * A  # (K, d, d)
        diagonal = torch.diag_embed(observed)
        diagonal[:-1] += A.mT @ WA
        diagonal[1:] += torch.diag(precision)
        if d > 2 * n:  # a constant added to s may be unseen: hold the first one weakly
            diagonal[0, 2 * n, 2 * n] += 1e-12 * diagonal[:, 2 * n, 2 * n].max()
        zero = torch.zeros_like(diagonal[:1])
        blocks = diagonal, torch.cat([-WA.mT, zero]), torch.cat([zero, -WA])
        defect = y[:, :d] - x[1:, :d]
        gradient = observed * (x[:, :d] - target)
        gradient[:-1] += (WA.mT @ defect[..., None])[..., 0]
        gradient[1:] -= precision * defect
        step = torch.zeros_like(x)
        step[:, :d] = solve_blocks(blocks, -gradient)
        for k in range(HALVINGS):
            trial = x + step / 2**k
            stepped_there = all_steps(L_d, trial[None], h)
            if stepped_there is not None and bool(cost_of(trial, stepped_there[0][0]) <= cost * (1 + 1e-12)):
                break
        else:
            break
        new = cost_of(trial, stepped_there[0][0])
        x, stepped, gain, cost = trial, stepped_there, cost - new, new
        if float(gain) <= 1e-10 * float(cost) + 1e-300:
            break
    assert blocks is not None
    if d == 2 * n:  # s only counts along
        x[1:, 2 * n] = x[0, 2 * n] + _gained(L_d, x, h)
    return x, _variances(*blocks), node


def _guess(L_d: FixedModel, data: Trajectories, h: Tensor, node: Tensor) -> Tensor:
    """Positions on straight lines between samples, momenta by FL⁻, s = 0: (K+1, 2n+1)."""
    K, n = h.shape[1], data.dof
    t = torch.cat([h.new_zeros(1), h[0].cumsum(0)])
    right = torch.searchsorted(node, torch.arange(K + 1, device=node.device)).clamp(1, len(node) - 1)
    a, b = node[right - 1], node[right]
    share = ((t - t[a]) / (t[b] - t[a]))[:, None]
    q = data.q[right - 1] * (1 - share) + data.q[right] * share
    _, p, _ = legendre_minus(L_d, q[None, :-1], q[None, 1:], torch.zeros_like(h), h)
    x = q.new_zeros(K + 1, 2 * n + 1)
    x[:, :n], x[:-1, n : 2 * n], x[-1, n : 2 * n] = q, p[0], p[0, -1]
    return x


def _gained(L_d: FixedModel, x: Tensor, h: Tensor) -> Tensor:
    """Values of s along the smoothed positions where it does not enter the motion, less its start, (K,)."""
    n = (x.shape[1] - 1) // 2
    s = x[0, 2 * n]
    P = partials(L_d, x[None, :-1, :n], x[None, 1:, :n], torch.zeros_like(h), h)
    out = []
    for L, c in zip(P.L[0], P.c[0], strict=True):  # L_d = L_d(s = 0) + (c − 1) s
        s = c * s + L
        out.append(s)
    return torch.stack(out) - x[0, 2 * n]


def _variances(diagonal: Tensor, upper: Tensor, lower: Tensor) -> Tensor:
    """Diagonal of the inverse, (K+1, d), by elimination from both ends: (A⁻¹)_kk = (S_k + T_k − D_k)⁻¹."""
    count = len(diagonal)
    S, T = [diagonal[0]], [diagonal[-1]]
    for k in range(1, count):
        S.append(diagonal[k] - lower[k] @ torch.linalg.solve(S[-1], upper[k - 1]))
        j = count - 1 - k
        T.append(diagonal[j] - upper[j] @ torch.linalg.solve(T[-1], lower[j + 1]))
    both = torch.stack(S) + torch.stack(T[::-1]) - diagonal
    return torch.linalg.inv(both).diagonal(dim1=-2, dim2=-1)
