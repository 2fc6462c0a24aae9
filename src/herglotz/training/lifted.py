"""All steps of a trajectory solved at once: Newton on the whole trajectory instead of one step after another.

With a guess X for every state, each sweep evaluates all K steps Φ̃(X_k) and their derivatives A_k in one batch and
then carries the defects forward, e_{k+1} = A_k e_k + Φ̃(X_k) − X_{k+1}. It converges quadratically, needs two to four
sweeps from the trajectory of a slightly different parameter vector, and costs a few batched evaluations where
stepping costs K small ones (Albersmeyer & Diehl 2010, the lifted Newton method).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.mechanics import momentum_plus, step_derivative
from herglotz.stepping import Status, solve_step
from herglotz.training.flat import FixedModel, FlatModel


@dataclass(frozen=True)
class Path:
    """A solved batch of trajectories and the derivatives of their steps."""

    x: Tensor  # (S, K+1, 2n+1) states q, p, s
    A: Tensor  # (S, K, 2n+1, 2n+1) DΦ̃ of each step


def solve_path(
    flat: FlatModel,
    theta: Tensor,  # (P,)
    start: Tensor,  # (S, 2n+1) first states
    h: Tensor,  # (S, K)
    guess: Tensor,  # (S, K+1, 2n+1)
    tol: float,
    sweeps: int = 12,
    u: Tensor | None = None,  # (S, K, m) input of every step
) -> Path | None:
    """The trajectories from `start`, or None where the sweeps do not converge."""
    x = torch.cat([start[:, None], guess[:, 1:]], 1)
    previous = float("inf")
    for _ in range(sweeps):
        stepped = all_steps(flat.at(theta, u), x, h)
        if stepped is None:
            return None
        y, A = stepped
        defect = y - x[:, 1:]
        size = float(defect.abs().amax(dim=(0, 1)).div(x.abs().amax(dim=(0, 1)) + 1e-300).max())
        if size <= tol or (size <= 1e3 * tol and size >= previous / 2):
            return Path(torch.cat([start[:, None], y], 1) if size == 0 else x, A)
        e = [torch.zeros_like(start)]
        for k in range(h.shape[1]):
            e.append((A[:, k] @ e[-1][..., None])[..., 0] + defect[:, k])
        x = x + torch.stack(e, 1)
        previous = size
        if not bool(torch.isfinite(x).all()):
            return None
    return None


def all_steps(L_d: FixedModel, x: Tensor, h: Tensor) -> tuple[Tensor, Tensor] | None:
    """Φ̃ at every state but the last, and its derivative; None if any step fails."""
    n = (x.shape[-1] - 1) // 2
    q0, p0, s0 = x[:, :-1, :n], x[:, :-1, n : 2 * n], x[:, :-1, 2 * n]
    tol = 64 * torch.finfo(x.dtype).eps
    solution = solve_step(L_d, q0, p0, s0, h, x[:, 1:, :n], tol)
    if not bool((solution.status == Status.CONVERGED).all()):
        return None
    P = solution.P
    y = torch.cat([solution.q1, momentum_plus(P), (s0 + P.L)[..., None]], -1)
    return y, step_derivative(P, p0)
