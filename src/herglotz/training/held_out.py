"""Errors of held-out blocks of time for any subset of the numbers of a fit, to first order.

The motion is linearised once, by all numbers that a model may have. Leaving out a block, adding a number and removing
a number are then linear algebra. The start of a segment is estimated from its samples outside the block or, if there
are none, from all its samples. The joints between segments do not enter.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from herglotz.data import Trajectories
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.solvers.lifted_newton import Path

# Least number of blocks of time over all trajectories.
BLOCKS = 10
# Leading samples of a trajectory, at most a tenth of it, that are never left out, because they determine its start.
STAY = 20
# Added to curvatures with a unit diagonal, which may be singular.
RIDGE = 1e-12
# Samples whose products with large matrices are computed at once.
SAMPLES_AT_ONCE = 2**14


class HeldOut:
    """A fit linearised at `theta`; the start states of segments follow the numbers.

    `fitted` are the numbers at their optimum, which do not move unless a block is left out (None: all). `leaving` is
    the step of a number that is left out (None: 0). `waves` are the prior weights of the waves of functions, 0 for
    other numbers.
    """

    def __init__(
        self,
        problem: ShootingProblem,
        path: Path,
        theta: Tensor,  # (P,)
        fitted: Sequence[int] | None = None,
        leaving: Tensor | None = None,  # (P,)
        waves: Tensor | None = None,  # (P,)
    ):
        self.block, self.sigma, P = blocks(problem.data).to(theta.device), problem.sigma, problem.P
        self.runs = runs_of(self.block)
        self.complete = problem.data.complete
        zero = torch.zeros_like(theta)
        self.leaving, self.waves = (zero if x is None else x for x in (leaving, waves))
        rows, by = _rows_of(problem, path, theta)
        segment = problem.grid.segment
        piece, of = torch.unique_consecutive(torch.stack([segment, self.block], 1), dim=0, return_inverse=True)
        weighted = rows * by[..., None]
        own = _by_start(weighted, of, len(piece), P)  # (Q, d, P + 1 + d)
        whole = own.new_zeros(problem.grid.segments, *own.shape[1:]).index_add_(0, piece[:, 0], own)
        self.following = _following(whole, P)
        _, A, b = problem.prior_equations(theta)
        fit = _summed(weighted, P) - _products(whole[..., :P], self.following) + torch.cat([A, b[:, None]], 1)
        self.equations = fit.repeat(int(self.block.max()) + 2, 1, 1)
        # With joints the samples alone have another optimum.
        if not problem.jointed:
            self.equations[:, list(range(P) if fitted is None else fitted), P] = 0.0
        # [J, r] with the states following, of the fit to all samples.
        self.fitted_rows = rows[..., : P + 1] - _gathered(rows[..., P + 1 :], self.following, segment)
        # The start of a piece that is left out follows the rest of its segment or, if the segment lies inside the block
        # and so has one piece, the piece.
        out = piece[:, 1] >= 0
        s, block = piece[out].T
        pieces = runs_of(block)
        gone, kept = (torch.bincount(piece[:, 0])[s] == 1)[:, None, None], whole[s] - own[out]
        starts = _following(torch.where(gone, own[out], kept), P)
        before, after = whole[s][..., :P], torch.where(gone, 0.0, kept[..., :P])
        for k in range(len(self.equations) - 1):
            mine, at = pieces[k], self.runs[k]
            eliminated = _products(before[mine], self.following[s[mine]]) - _products(after[mine], starts[mine])
            self.equations[k] += eliminated - _summed(weighted[at], P)
        # [J, r], each sample for the fit without its block.
        self.rows = rows[..., : P + 1].clone()
        at, place = self.block >= 0, out.cumsum(0) - 1
        self.rows[at] -= _gathered(rows[at][..., P + 1 :], starts, place[of[at]])

    def residuals(self, sets: Sequence[Sequence[int]]) -> Tensor:
        """Held-out residuals over the balance, (C, N, n), for C sets of numbers; NaN if a set has no solution.

        Samples in no block keep the residuals of the fit.
        """
        P = self.rows.shape[-1] - 1
        out = self.rows[..., P].repeat(len(sets), 1, 1)
        for k, by in enumerate(self._steps(self.equations[:-1], sets)):
            own = self.runs[k]
            out[:, own] += (self.rows[own][..., :P] @ by.T).permute(2, 0, 1)
        return out * self.sigma

    def fitted_residuals(self, sets: Sequence[Sequence[int]]) -> Tensor:
        """Residuals of the fits to all samples over the balance, (C, N, n), for C sets of numbers; NaN: no solution."""
        P = self.rows.shape[-1] - 1
        (steps,) = self._steps(self.equations[-1:], sets)
        return (self.fitted_rows[..., P] + (self.fitted_rows[..., :P] @ steps.T).permute(2, 0, 1)) * self.sigma

    def steps(self, own: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Steps of the numbers (P,) and of the starts of segments (S, d) in a model of `own`; NaN: no solution."""
        ((step,),) = self._steps(self.equations[-1:], [own])
        return step, -self.following @ torch.cat([step, step.new_ones(1)])

    def _steps(self, equations: Tensor, sets: Sequence[Sequence[int]]) -> Tensor:
        """Steps of all numbers, (B, C, P), for each of the equations (B, P, P + 1) and each of C sets."""
        joined = sorted(set().union(*sets))
        left_out = [[x for x in joined if x not in own] for own in map(frozenset, sets)]
        most, k, count = max(map(len, left_out)), len(joined), len(sets)
        # Products of one inverse, from which the solutions of all sets follow, or of a Cholesky factor for each set.
        if k**3 + count * most**2 * k < count * k**3 / 3:
            found = self._steps_without(equations, joined, left_out)
            if found is not None:
                return found
        P, index = self.rows.shape[-1] - 1, self._index(sets)
        inside = torch.zeros(len(sets), P + 1, dtype=torch.bool, device=index.device).scatter_(1, index, True)[:, :P]
        moved = torch.where(inside, 0.0, self.leaving)  # (C, P)
        factor, size, at = _factors(equations, index)
        b = (equations[..., P, None] + equations[..., :P] @ moved.T).mT.gather(2, at)  # (B, C, k)
        x = -torch.cholesky_solve((b / size)[..., None], factor)[..., 0] / size
        return moved.repeat(len(equations), 1, 1).scatter_add(2, at, torch.where(index < P, x, 0.0))

    def _steps_without(
        self, equations: Tensor, joined: Sequence[int], left_out: Sequence[Sequence[int]]
    ) -> Tensor | None:
        """Steps of all numbers, (B, C, P), in C sets that lack few numbers of a `joined` set; None if that is singular.

        A number that is left out is held at its step `leaving` by a multiplier, the force of a constraint.
        """
        own, places = torch.tensor(joined, device=equations.device), {x: i for i, x in enumerate(joined)}
        (A,), (size,), _ = (x.movedim(1, 0) for x in _scaled(equations, own[None]))  # (B, k, k), (B, k)
        factor, info = torch.linalg.cholesky_ex(A)
        if bool(info.any()):
            return None
        moved = self.leaving.clone()
        moved[own] = 0.0
        b = (equations[..., -1] + equations[..., :-1] @ moved)[:, own] / size
        inverse = torch.cholesky_inverse(factor)
        x = -(inverse @ b[..., None])[..., 0]
        # Places of the numbers that are left out, (C, r), padded with k, which is no place.
        k, width = len(own), max(map(len, left_out))
        out = [[*(places[number] for number in numbers), *[k] * (width - len(numbers))] for numbers in left_out]
        at = torch.tensor(out, dtype=torch.long, device=own.device).reshape(len(left_out), width)
        response = pad(inverse, (0, 1, 0, 1))[:, at]  # (B, C, r, k + 1)
        own_response = response.gather(3, at[:, None].expand(*response.shape[:3], width))
        own_response = own_response + torch.diag_embed((at == k).to(x))
        wanted = pad(size * self.leaving[own] - x, (0, 1))[:, at]
        force = torch.linalg.solve_ex(own_response, wanted)[0]  # (B, C, r)
        found = moved.repeat(len(equations), len(at), 1)
        found[..., own] = (x[:, None] + (force[..., None, :] @ response)[..., 0, :-1]) / size[:, None]
        return found

    def told(self, sets: Sequence[Sequence[int]]) -> Tensor:
        """The effective share of each number, (C, P): 1 − σ²/τ² for a wave with prior and posterior deviations τ and σ.

        0 for a number outside the set, 1 for a number of the set that is no wave (MacKay 1992).
        """
        P, index = self.rows.shape[-1] - 1, self._index(sets)
        found = torch.zeros(len(sets), P + 1, dtype=self.rows.dtype, device=index.device).scatter_(1, index, 1.0)[:, :P]
        if bool(self.waves.any()):
            (factor,), (size,), (at,) = _factors(self.equations[-1:], index)
            variance = torch.cholesky_inverse(factor).diagonal(dim1=-2, dim2=-1) / size.square()
            untold = (self.waves[at] * variance).clamp(max=1.0).nan_to_num(nan=0.0) * (index < P)
            found = found.scatter_add(1, at, -untold)
        return found

    def _index(self, sets: Sequence[Sequence[int]]) -> Tensor:
        """The numbers of each set, (C, k), padded with P, which is no number."""
        P, width = self.rows.shape[-1] - 1, max(len(own) for own in sets)
        padded = [[*own, *[P] * (width - len(own))] for own in sets]
        return torch.tensor(padded, device=self.rows.device).reshape(len(sets), width)


def _factors(equations: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Cholesky factors (B, C, k, k) of the curvatures of sets scaled to a unit diagonal, the scales, and the places.

    The factor is NaN if the curvature is not positive definite.
    """
    A, size, at = _scaled(equations, index)
    factor, info = torch.linalg.cholesky_ex(A)
    return torch.where((info == 0)[..., None, None], factor, torch.nan), size, at


def _scaled(equations: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Curvatures (B, C, k, k) of sets scaled to a unit diagonal, the scales, and the places."""
    P = equations.shape[1]
    A = equations[..., :P]
    size = A.diagonal(dim1=-2, dim2=-1)
    size = torch.where(size > 0, size, 1.0).sqrt()
    A = pad((A / size[..., None] / size[..., None, :]).nan_to_num(nan=-1.0), (0, 1, 0, 1))
    A, there = A[:, index[:, :, None], index[:, None, :]], index < P
    A.diagonal(dim1=-2, dim2=-1).add_(torch.where(there, RIDGE, 1.0))
    return A, pad(size, (0, 1), value=1.0)[:, index], index.clamp(max=P - 1).expand(len(A), *index.shape)


def blocks(data: Trajectories) -> Tensor:
    """The block of time of every sample, (N,); −1: never left out. Every trajectory has at least two blocks."""
    each, parts, first = max(2, -(-BLOCKS // len(data))), [], 0
    for length in data.lengths:
        part = torch.arange(length) * each // length + first
        part[: min(STAY, length // 10)] = -1
        parts.append(part)
        first += each
    return torch.cat(parts)


def _rows_of(problem: ShootingProblem, path: Path, theta: Tensor) -> tuple[Tensor, Tensor]:
    """Derivatives by numbers, residuals, and derivatives by starts, (N, n, P + 1 + d), over σ; and weights (N, n)."""
    r, P = problem.misfit(path) / problem.sigma, problem.P
    slopes = problem.slopes_at_samples(theta, path) / problem.deviations[:, None]
    by = problem.weight * problem.root_weights(problem.weight * r)
    return torch.cat([slopes[..., :P], r[..., None], slopes[..., P:]], -1), by


def _gathered(by_start: Tensor, moved: Tensor, of: Tensor) -> Tensor:
    """The products of by_start (N, n, d) and moved[of] (N, d, W), (N, n, W), in parts of bounded memory."""
    parts = zip(by_start.split(SAMPLES_AT_ONCE), of.split(SAMPLES_AT_ONCE), strict=True)
    return torch.cat([x @ moved[own] for x, own in parts])


def runs_of(block: Tensor) -> list[slice]:
    """Where each block k ≥ 0 stands among values (N,) that are −1 or blocks in order; an empty slice if it does not."""
    there, counts = torch.unique_consecutive(block, return_counts=True)
    ends = counts.cumsum(0).tolist()
    found = {k: slice(end - count, end) for k, end, count in zip(there.tolist(), ends, counts.tolist(), strict=True)}
    return [found.get(k, slice(0)) for k in range(int(block.max()) + 1)]


def _by_start(rows: Tensor, of: Tensor, count: int, P: int) -> Tensor:
    """Σ startᵀ row of each piece, (Q, d, P + 1 + d); a piece is a run of consecutive samples."""
    counts = torch.bincount(of, minlength=count).tolist()
    parts = [part.flatten(0, 1) for part in rows.split(counts)]
    return torch.stack([part[:, P + 1 :].T @ part for part in parts])


def _summed(rows: Tensor, P: int) -> Tensor:
    """[C, b_θ]: Σ Jᵀ [J, r], (P, P + 1)."""
    return _products(rows[..., :P], rows[..., : P + 1])


def _products(x: Tensor, y: Tensor) -> Tensor:
    """Σ xᵀ y over the leading axes of x (Q, d, P) and y (Q, d, W), (P, W)."""
    return x.flatten(0, 1).T @ y.flatten(0, 1)


def _following(by_start: Tensor, P: int) -> Tensor:
    """T⁻¹ [B, b_x] of each segment, (S, d, P + 1): minus (derivatives of its start by the numbers, own step)."""
    T = by_start[..., P + 1 :]
    size = T.diagonal(dim1=-2, dim2=-1)
    T = T + torch.diag_embed(RIDGE * size + torch.finfo(T.dtype).tiny ** 0.5)
    return torch.linalg.solve(T, by_start[..., : P + 1])
