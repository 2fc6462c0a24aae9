"""Lifted Newton method: all steps of a trajectory solved at once instead of one after another.

From a guess X of every state, each sweep evaluates all K steps Φ̃(X_k) and their derivatives A_k in one batch and
carries the defects forward, e_{k+1} = A_k e_k + Φ̃(X_k) − X_{k+1} (Albersmeyer & Diehl 2010). Sweeps converge
quadratically: two to four suffice from the trajectory of slightly different parameters. Stepping would need K small
evaluations in a row instead of a few batched evaluations.

Φ̃ is implicit. Its equation F(q_k, q_{k+1}) = 0 is linearised about the guess of q_{k+1} in the same sweep, so that a
sweep costs one evaluation of L_d (`linear_steps`). If these sweeps do not converge, sweeps that solve every step
follow (`all_steps`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from herglotz.mechanics import (
    DiscreteLagrangian,
    Partials,
    momentum_jacobian,
    momentum_plus,
    momentum_residual,
    partials,
    step_derivative,
)
from herglotz.mechanics.legendre import soft_threshold, unheld_jacobian, unheld_residual
from herglotz.models import capabilities
from herglotz.progress import beat
from herglotz.stepping import State, Status, solve, solve_step
from herglotz.training.distributed import add_over_processes, own_parts
from herglotz.training.parameter_vector import FixedModel
from herglotz.training.problems.grid import SegmentGrid

# Relative defect below which a sweep may be the last: quadratic convergence then leaves only rounding.
QUADRATIC_DEFECT = 1e-7
# Assumed ratio of a defect to the square of the previous defect, before two defects give the ratio.
FIRST_CURVATURE = 1e4
# Rounding that sweeps over all steps leave in a state, in machine epsilons.
SWEPT = 1e3
# A coordinate is at rest if it moves by less than this many roundings, which sums of corrections leave.
REST_ROUNDINGS = 64.0
# Iterations of a piecewise linear equation.
PIECEWISE_ITERATIONS = 4
# Steps whose parameter Jacobian is kept in memory at once.
CHUNK_STEPS = 4096


@dataclass(frozen=True)
class Path:
    """A solved batch of trajectories (q, p, s) and DΦ̃, the derivative of each step; A is None if a kernel ran."""

    x: Tensor  # (S, K+1, 2n+1)
    A: Tensor | None  # (S, K, 2n+1, 2n+1)


def solve_path(
    L_d: DiscreteLagrangian,
    start: Tensor,  # (S, 2n+1)
    h: Tensor,  # (S, K)
    guess: Tensor,  # (S, K+1, 2n+1)
    tol: float,
    sweeps: int = 12,
) -> Path | None:
    """The trajectories from the states `start`; None if the sweeps do not converge.

    L_d is evaluated at the inputs of every step, if it takes any. `tol` is relative to the largest state.
    """
    path = _swept(linear_steps, L_d, start, h, guess, tol, sweeps)
    return _swept(all_steps, L_d, start, h, guess, tol, sweeps) if path is None else path


def _swept(
    step: Callable[[DiscreteLagrangian, Tensor, Tensor], tuple[Tensor, Tensor] | None], L_d: DiscreteLagrangian,
    start: Tensor, h: Tensor, guess: Tensor, tol: float, sweeps: int,
) -> Path | None:  # fmt: skip
    x = torch.cat([start[:, None], guess[:, 1:]], 1)
    previous = float("inf")
    for _ in range(sweeps):
        beat()
        stepped = step(L_d, x, h)
        if stepped is None:
            return None
        y, A = stepped
        defect = y - x[:, 1:]
        size = float(defect.abs().amax(dim=(0, 1)).div(x.abs().amax(dim=(0, 1)) + 1e-300).max())
        if size <= tol or (size <= 1e3 * tol and size >= previous / 2):
            return Path(torch.cat([start[:, None], y], 1) if size == 0 else x, A)
        x = x + linear_recurrence(A, defect[..., None], torch.zeros_like(start)[..., None])[..., 0]
        if not bool(torch.isfinite(x).all()):
            return None
        curvature = size / previous / previous if previous < math.inf else FIRST_CURVATURE
        # A belongs to the states before this correction, of a size of at most `QUADRATIC_DEFECT`.
        if size <= QUADRATIC_DEFECT and 10 * curvature * size**2 <= tol:
            return Path(x, A)
        previous = size
    return None


def attached(
    L_d: DiscreteLagrangian,
    path: Path,
    start: Tensor,  # (S, 2n+1)
    h: Tensor,  # (S, K)
) -> Tensor:
    """The states (S, K+1, 2n+1) of a path from `start`, with first derivatives by θ, u, h and `start` for autograd.

    One more sweep, whose correction has the value 0: by the implicit-function theorem, the derivative of a Newton step
    at the solution is the derivative of the solution.
    """
    y, A = linear_steps(L_d, path.x, h)
    moved = linear_recurrence(A.detach(), (y - path.x[:, 1:])[..., None], (start - path.x[:, 0])[..., None])
    return path.x + moved[..., 0]


def linear_recurrence(
    A: Tensor,  # (S, K, d, d)
    B: Tensor,  # (S, K, d, r)
    first: Tensor,  # (S, d, r)
) -> Tensor:
    """Z_0 = first, Z_{k+1} = A_k Z_k + B_k, (S, K+1, d, r), by about 2 √K batched products instead of K small products.

    The recurrence is divided into about √K blocks. All blocks at once give their ends from Z = 0 and the products of
    their A; from block to block these give the start of each block; all blocks at once then give the states between.
    """
    S, K, d = A.shape[:3]
    length = max(1, math.isqrt(K))
    blocks = -(-K // length)
    more = blocks * length - K
    eye = torch.eye(d, dtype=A.dtype, device=A.device)
    padded = torch.cat([A, eye.expand(S, more, d, d)], 1), torch.cat([B, B.new_zeros(S, more, *B.shape[2:])], 1)
    # (length, S · blocks, d, …): the products of step k of all blocks are one batch, contiguous in memory.
    A, B = (x.unflatten(1, (blocks, length)).movedim(2, 0).flatten(1, 2).contiguous() for x in padded)
    own, product = torch.zeros_like(B[0]), eye.expand(S * blocks, d, d)
    for k in range(length):
        own, product = torch.baddbmm(B[k], A[k], own), A[k] @ product
    starts = [first]
    for end, through in zip(
        own.unflatten(0, (S, blocks)).unbind(1), product.unflatten(0, (S, blocks)).unbind(1), strict=True
    ):
        starts.append(through @ starts[-1] + end)
    inside = [torch.stack(starts[:-1], 1).flatten(0, 1)]
    for k in range(length - 1):
        inside.append(torch.baddbmm(B[k], A[k], inside[-1]))
    states = torch.stack(inside, 1).unflatten(0, (S, blocks)).flatten(1, 2)
    return torch.cat([states, starts[-1][:, None]], 1)[:, : K + 1]


def all_steps(L_d: DiscreteLagrangian, x: Tensor, h: Tensor) -> tuple[Tensor, Tensor] | None:
    """Φ̃ at every state but the last, with every step solved, and its derivative; None if any step fails."""
    n = (x.shape[-1] - 1) // 2
    q0, p0, s0 = x[:, :-1, :n], x[:, :-1, n : 2 * n], x[:, :-1, 2 * n]
    tol = 64 * torch.finfo(x.dtype).eps
    solution = solve_step(L_d, State(q0, p0, s0), h, x[:, 1:, :n], tol)
    if not bool((solution.status == Status.CONVERGED).all()):
        return None
    P = solution.P
    y = torch.cat([solution.q1, momentum_plus(P), (s0 + P.L)[..., None]], -1)
    return y, step_derivative(P, p0)


def linear_steps(L_d: DiscreteLagrangian, x: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """Φ̃ at every state but the last, with F linearised about q of the next state, and its derivative.

    The result is that of `all_steps` if F = 0 at the next state. With set-valued friction the linearised inclusion is
    solved, which decides for each coordinate whether it sticks.
    """
    n = (x.shape[-1] - 1) // 2
    q0, p0, s0, q1 = x[:, :-1, :n], x[:, :-1, n : 2 * n], x[:, :-1, 2 * n], x[:, 1:, :n]
    made_of = capabilities(L_d)
    if sticking := made_of is not None and made_of.sticking:
        q1 = torch.where((q1 - q0).abs() <= REST_ROUNDINGS * torch.finfo(x.dtype).eps * q0.abs(), q0, q1)
    P = partials(L_d, q0, q1, s0, h, order=2)
    if sticking:
        dq, P = _linear_inclusion(P, p0, q1 - q0)
    else:
        dq = -solve(momentum_jacobian(P, p0), momentum_residual(P, p0))
    # ∂p1/∂q1
    slope = P.D22 if P.force is None else P.D22 + P.force.plus_2
    p1, s1 = momentum_plus(P) + (slope @ dq[..., None])[..., 0], s0 + P.L + (P.D2 * dq).sum(-1)
    return torch.cat([q1 + dq, p1, s1[..., None]], -1), step_derivative(P, p0)


def _linear_inclusion(P: Partials, p0: Tensor, delta: Tensor) -> tuple[Tensor, Partials]:
    """The solution of the inclusion F(Δ) ∈ w Sgn(Δ), F linearised about `delta`, minus `delta`; and P there.

    F is without dry friction, whose largest impulse is w. With z = Δ + λ/K as in `herglotz.stepping.newton`, λ
    being the impulse of friction, G(z) = F(Δ) − K (z − Δ) = 0 is piecewise linear.
    """
    assert P.force is not None
    assert P.force.grip is not None
    J, w = unheld_jacobian(P, p0), P.force.grip
    F, K = unheld_residual(P, p0) + w * delta.sign(), J.diagonal(0, -2, -1).abs()
    bound, z = w / K, delta + torch.where(delta == 0, F, w * delta.sign()) / K
    for _ in range(PIECEWISE_ITERATIONS):
        moved = soft_threshold(z, bound)
        G = F + (J @ (moved - delta)[..., None])[..., 0] - K * (z - moved)
        slope = torch.where((moved != 0)[..., None, :], J + torch.diag_embed(K), 0.0) - torch.diag_embed(K)
        z = z - solve(slope, G)
    moved = soft_threshold(z, bound)
    return moved - delta, replace(P, force=replace(P.force, held=torch.where(moved == 0, w, 0.0)))


def step_derivatives(L_d: FixedModel, path: Path, grid: SegmentGrid) -> Tensor:
    """DΦ̃ of every step of a path, (S, K, 2n+1, 2n+1), without meaning behind the end of a segment."""
    if path.A is not None:
        return path.A
    there = torch.arange(path.x.shape[1], device=path.x.device) <= grid.end[:, None]
    return linear_steps(L_d, torch.where(there[..., None], path.x, path.x[:, :1]), grid.h)[1]


def parameter_derivatives(
    L_d: FixedModel,
    x: Tensor,  # (S, K+1, 2n+1)
    q1: Tensor,  # (S, K, n)
    A: Tensor,  # (S, K, d, d)
    h: Tensor,  # (S, K)
) -> Tensor:
    """∂Φ̃(x_k)/∂θ of every step, (S, K, d, P), by the implicit-function theorem.

    The steps lead from the states x, the last of which is not used, to the positions q1; A is DΦ̃ of each step, with
    d = 2n or, if s enters the motion, d = 2n + 1. L_d is evaluated at the inputs of every step.
    With F = D1 L_d + c p0 = 0, dq1/dθ = −J⁻¹ ∂F/∂θ. Since ∂F/∂p0 = c, the columns of DΦ̃ for p0, over c, are −J⁻¹ and
    the derivatives of p1 and s1 that follow from −J⁻¹; their product with ∂F/∂θ is the part of θ that acts through q1.
    """
    (S, K, n), d, theta, u = q1.shape, A.shape[-1], L_d.theta, L_d.u
    x, ends, steps = x[:, :-1].flatten(0, 1), q1.flatten(0, 1), h.flatten()
    by_push, inputs = A[..., n : 2 * n].flatten(0, 1), None if u is None else u.flatten(0, 1)

    def step_functions(theta: Tensor, x: Tensor, q1: Tensor, h: Tensor, u: Tensor | None) -> tuple[Tensor, Tensor]:
        P = L_d.parameters.partials(theta, x[:n], q1, x[2 * n], h, 1, u)
        made = torch.cat([momentum_residual(P, x[n : 2 * n]), momentum_plus(P), P.L[None]])
        return made[:d], P.c

    per_step = vmap(jacrev(step_functions, has_aux=True), (None, 0, 0, 0, None if u is None else 0))
    out = x.new_zeros(S * K, d, len(theta))
    for _, part in own_parts(S * K, CHUNK_STEPS, x.device):
        G, c = per_step(theta, x[part], ends[part], steps[part], None if inputs is None else inputs[part])
        F, G = G[:, :n], G.index_fill(1, torch.arange(n, device=x.device), 0.0)
        out[part] = G + (by_push[part] / c[:, None, None]) @ F
    add_over_processes(out)
    return out.reshape(S, K, d, len(theta))
