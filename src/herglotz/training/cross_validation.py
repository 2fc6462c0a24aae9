"""Errors of a fitted trajectory over held-out blocks of time, without fitting again."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.training.arrowhead import Arrowhead, dense
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.solvers.lifted_newton import Path

# Held-out blocks: fifths of every trajectory, in time.
FOLDS = 5
# First samples of a driven trajectory that are never left out, but at most half of the first fold.
STAY = 20
# A start is never left out if its deviation is smaller than σ by more than this factor.
SURE = 10
# A weaker prior or a richer level must lower the error by more than this factor.
MARGIN = 1.05


def held_out_errors(
    problem: ShootingProblem,
    path: Path,
    theta: Tensor,  # (P,)
    A: Tensor | Arrowhead,  # (unknowns, unknowns) JᵀJ at the fit, prior included
) -> Tensor:
    """Return the RMS error of each fold if its samples had been left out, (FOLDS,), in units of q.

    Fold j is the j-th fifth, in time, of every trajectory. To first order a least-squares fit without the rows B has
    there the residual (I − J_B A⁻¹ J_Bᵀ)⁻¹ r_B (Allen's PRESS, for blocks). The blocks are blocks of time, because the
    residuals of a deterministic model are correlated over long times: neighbours of a single left-out sample would
    foretell the sample. Starts whose deviation is far smaller than σ are never left out: a free run begins there.
    """
    r, G = _whitened(*data_rows(problem, path, theta), dense(A))
    # The higher precision of known starts counts in r and J, and not in errors in units of q.
    better = problem.better.flatten().to(r)
    errors = left_out_errors(r, problem.data, lambda rows: _left_out(G[rows], r[rows]) / better[rows], better > SURE)
    return errors * problem.sigma


def foretold_errors(problem: ShootingProblem, path: Path, theta: Tensor, A: Tensor) -> Tensor:
    """`held_out_errors` over their expectation: (FOLDS,), 1 where residuals are white noise of σ.

    With H = J_B A⁻¹ J_Bᵀ a fit without the rows B misses them by e = (I − H)⁻¹ r_B. If the model is true, e has the
    covariance (I − H)⁻¹, and the result is the root of eᵀ(I − H) e / |B|. With many parameters left-out blocks
    have large errors, because each block alone determines some parameters.
    """
    # The prior's weights of waves differ by many orders of magnitude.
    size = A.diagonal().sqrt()
    r, J = data_rows(problem, path, theta)
    r, G = _whitened(r, J.double() / size, A / size[:, None] / size)
    each = lambda rows: (r[rows] @ _left_out(G[rows], r[rows]) / rows.sum()).sqrt()[None]  # noqa: E731
    return left_out_errors(r, problem.data, each, problem.better.flatten() > SURE)


def _whitened(r: Tensor, J: Tensor, A: Tensor) -> tuple[Tensor, Tensor]:
    """Data residuals (N·n,), and G (N·n, K) with G Gᵀ = J A⁻¹ Jᵀ, float64."""
    values, vectors = torch.linalg.eigh(A.double())
    known = values > len(values) * torch.finfo(values.dtype).eps * values[-1]
    return r.double(), J.double() @ (vectors[:, known] / values[known].sqrt())


def data_rows(problem: ShootingProblem, path: Path, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Data residuals and their Jacobian, (N·n,) and (N·n, unknowns), over σ and in the order of the samples.

    Both carry the square roots of the weights: those of a robust loss, those of known starts, and 0 for
    samples that are not used.
    """
    r = problem.misfit(path) / problem.sigma
    by = problem.weight * problem.root_weights(problem.weight * r)
    Z = problem.slopes_at_samples(theta, path) * (by / problem.deviations)[..., None]
    segment = problem.grid.segment
    J = Z.new_zeros(len(Z), problem.n, problem.P + problem.grid.segments * problem.d)
    J[..., : problem.P] = Z[..., : problem.P]
    for i in range(problem.d):
        J[torch.arange(len(Z)), :, problem.P + segment * problem.d + i] = Z[..., problem.P + i]
    return (by * r).flatten(), J.flatten(0, 1)


def _left_out(G: Tensor, r: Tensor) -> Tensor:
    """(I − G Gᵀ)⁻¹ r, which is r + G (I − Gᵀ G)⁻¹ Gᵀ r as well, by the smaller of both matrices."""
    if G.shape[0] <= G.shape[1]:
        return without_rows(G @ G.T, r)
    return r + G @ without_rows(G.T @ G, G.T @ r)


def without_rows(H: Tensor, r: Tensor) -> Tensor:
    """(I − H)⁻¹ r."""
    return torch.linalg.solve_ex(torch.eye(len(H), dtype=H.dtype, device=H.device) - H, r)[0]


def left_out_errors(
    r: Tensor,  # (N·n,) residuals of the data, in the order of the samples
    data: Trajectories,
    left_out: Callable[[Tensor], Tensor],  # (N·n,) bool, some rows → their residuals without them
    stay: Tensor | None = None,  # (N·n,) bool, rows that are in no fold
) -> Tensor:
    """RMS of r in each fold if its rows had been left out, (FOLDS,).

    The first samples of a driven trajectory stay: damped motion forgets its start, which later samples do not tell.
    """
    parts = [torch.arange(length) * FOLDS // length for length in data.lengths]
    if data.u is not None:
        for part in parts:
            part[: min(STAY, len(part) // (2 * FOLDS))] = -1
    fold = torch.cat(parts).repeat_interleave(data.dof).to(r.device)
    fold = fold if stay is None else fold.masked_fill(stay, -1)
    errors = torch.stack([left_out(fold == k).square().mean().sqrt() for k in range(FOLDS)]).nan_to_num(nan=torch.inf)
    # All rows of a fold may stay where trajectories are short.
    there = torch.stack([(fold == k).any() for k in range(FOLDS)])
    return torch.where(there, errors, errors[there].square().mean().sqrt())


def beaten(errors: Tensor, best: Tensor) -> bool:
    """Return whether held-out errors of blocks of time, (blocks,), exceed the best errors beyond their spread.

    The spread is the standard error over blocks of the difference of squared errors (the one-standard-error rule of
    Breiman et al. 1984). An error lower by less than a twentieth beats nothing, however certain: a weaker prior, or a
    parameter near zero, fits each block a little better and makes the free run beyond the data worse.
    """
    difference = errors.square() - best.square()
    spread = float(difference.std() / len(difference) ** 0.5)
    return not float(difference.mean()) <= max(spread, (MARGIN**2 - 1) * float(best.square().mean()))


def simplest_not_beaten(errors: dict[float, Tensor]) -> float:
    """Return the smallest key (the strongest prior) whose held-out errors the best errors do not beat."""
    best = min(errors, key=lambda k: float(errors[k].square().mean()))
    return next(key for key in sorted(errors) if key == best or not beaten(errors[key], errors[best]))
