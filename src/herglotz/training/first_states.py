"""States from neighbouring samples: at the starts of segments, and at every sample if a model follows no data."""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.mechanics import legendre_minus, legendre_plus
from herglotz.models import ContactLagrangian
from herglotz.training.problems.grid import step_inputs
from herglotz.training.problems.robust import robust_fit
from herglotz.training.problems.shooting import ShootingProblem

# Samples for a robust start state.
START = 8


def first_states(problem: ShootingProblem, theta: Tensor, smooth: Trajectories | None = None) -> Tensor:
    """Segment states from the first two samples, with p by FL⁻; with a robust loss from a robust cubic.

    `smooth` are the same samples, smoothed.
    """
    i, data = problem.grid.start_sample, smooth or problem.data
    q0, q1 = (data.q[i], data.q[i + 1]) if problem.freedom is None or smooth else _begin(data, i)
    with torch.no_grad():
        s = torch.zeros_like(data.t[i]) if problem.s is None else problem.s[i]
        u = None if problem.u is None else problem.u[:, 0]
        L_d = problem.parameters.at(theta, u)
        q, p, _ = legendre_minus(L_d, q0, q1, s, data.t[i + 1] - data.t[i])
    return problem.states(q, p, s)


def states_of_pairs(model: ContactLagrangian, data: Trajectories) -> Tensor:
    """The recorded positions with momenta by FL⁺ of each pair and s = 0, (N, 2n+1)."""
    n, u, out = data.dof, step_inputs(model, data), data.q.new_zeros(data.samples, 2 * data.dof + 1)
    i, first = data.steps().index, torch.tensor(data.offsets, device=data.t.device)
    out[:, :n] = data.q
    with torch.no_grad():
        for momentum, rows, at in ((legendre_plus, i, i + 1), (legendre_minus, first, first)):
            L_d, h = model if u is None else model.at(u[rows]), data.t[rows + 1] - data.t[rows]
            _, out[at, n : 2 * n], _ = momentum(L_d, data.q[rows], data.q[rows + 1], torch.zeros_like(h), h)
    return out


def _begin(data: Trajectories, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Positions at `rows` and at the next samples, (S, n) each, on cubics fitted to eight samples by Student's t."""
    first, second = data.q[rows].clone(), data.q[rows + 1].clone()
    fits = rows + START < data.samples
    inside = data.trajectory[(rows + START - 1).clamp_max(data.samples - 1)] == data.trajectory[rows]
    here = (fits & inside).nonzero()[:, 0]
    if not len(here):
        return first, second
    near = rows[here, None] + torch.arange(START, device=rows.device)
    x = data.t[near] - data.t[rows[here]][:, None]
    q = data.q[near].mT[..., None]  # (S, n, START, 1)
    A = torch.stack([x**k for k in range(4)], -1)[:, None].expand(*q.shape[:2], -1, -1)
    values = (A @ robust_fit(A, q))[..., 0]
    first[here], second[here] = values[..., 0], values[..., 1]
    return first, second
