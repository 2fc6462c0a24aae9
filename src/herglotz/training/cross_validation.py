"""Errors of a fitted trajectory over held-out blocks of time, without fitting again."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.training.arrowhead import Arrowhead
from herglotz.training.held_out import RIDGE
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
    A: Arrowhead,  # JᵀJ at the fit, prior included
) -> Tensor:
    """Return the RMS error of each fold if its samples had been left out, (FOLDS,), in units of q.

    Fold j is the j-th fifth, in time, of every trajectory. To first order a least-squares fit without the rows B has
    there the residual (I − J_B A⁻¹ J_Bᵀ)⁻¹ r_B (Allen's PRESS, for blocks). The blocks are blocks of time, because the
    residuals of a deterministic model are correlated over long times: neighbours of a single left-out sample would
    foretell the sample. Starts whose deviation is far smaller than σ are never left out: a free run begins there.
    """
    r, J = data_rows(problem, path, theta)
    # The higher precision of known starts counts in r and J, and not in errors in units of q.
    better = problem.better.to(r)
    left_out = lambda rows: _left_out(A, J, r, problem.grid.segment, rows) / better[rows]  # noqa: E731
    return left_out_errors(r, problem.data, left_out, better > SURE) * problem.sigma


def foretold_errors(problem: ShootingProblem, path: Path, theta: Tensor, A: Arrowhead) -> Tensor:
    """`held_out_errors` over their expectation: (FOLDS,), 1 where residuals are white noise of σ.

    With H = J_B A⁻¹ J_Bᵀ a fit without the rows B misses them by e = (I − H)⁻¹ r_B. If the model is true, e has the
    covariance (I − H)⁻¹, and the result is the root of eᵀ(I − H) e / |B|. With many parameters left-out blocks
    have large errors, because each block alone determines some parameters.
    """
    r, J = data_rows(problem, path, theta)

    def each(rows: Tensor) -> Tensor:
        return (r[rows] @ _left_out(A, J, r, problem.grid.segment, rows) / rows.sum()).sqrt()[None]

    return left_out_errors(r, problem.data, each, problem.better > SURE)


def data_rows(problem: ShootingProblem, path: Path, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Residuals of the samples (N, n) and their derivatives (N, n, P + d), over σ, in float64.

    The derivatives are by the parameters and by the start of the segment. Both carry the square roots of the weights:
    those of a robust loss, those of known starts, and 0 for samples that are not used.
    """
    r = problem.misfit(path) / problem.sigma
    by = problem.weight * problem.root_weights(problem.weight * r)
    J = problem.slopes_at_samples(theta, path) * (by / problem.deviations)[..., None]
    return (by * r).double(), J.double()


def _left_out(A: Arrowhead, J: Tensor, r: Tensor, segment: Tensor, rows: Tensor) -> Tensor:
    """The residuals of the rows B, (N, n) bool, of a fit without them; inf where that is not determined.

    (I − J_B A⁻¹ J_Bᵀ)⁻¹ r_B = r_B + J_B (A − J_Bᵀ J_B)⁻¹ J_Bᵀ r_B, whose matrix has the shape of A.
    """
    at = rows.any(1).nonzero()[:, 0]
    own, missed, of = J[at] * rows[at][..., None], r[at] * rows[at], segment[at]
    rest, b = A.without(own, missed, of)
    damping, P = RIDGE * A.diagonal().double(), len(A.corner)
    x = rest.solved(b, damping + torch.finfo(b.dtype).tiny ** 0.5)
    if x is None:
        return torch.full_like(r[rows], torch.inf)
    moved = torch.cat([x[:P].expand(len(at), P), x[P:].reshape(-1, A.border.shape[1])[of]], -1)
    return (missed + (own @ moved[..., None])[..., 0])[rows[at]]


def left_out_errors(
    r: Tensor,  # (N, n) residuals of the data, in the order of the samples
    data: Trajectories,
    left_out: Callable[[Tensor], Tensor],  # (N, n) bool, some rows → their residuals without them
    stay: Tensor | None = None,  # (N, n) bool, rows that are in no fold
) -> Tensor:
    """RMS of r in each fold if its rows had been left out, (FOLDS,).

    The first samples of a driven trajectory stay: damped motion forgets its start, which later samples do not tell.
    """
    parts = [torch.arange(length) * FOLDS // length for length in data.lengths]
    if data.u is not None:
        for part in parts:
            part[: min(STAY, len(part) // (2 * FOLDS))] = -1
    fold = torch.cat(parts)[:, None].expand(r.shape).to(r.device)
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
