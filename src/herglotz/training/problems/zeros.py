"""Zeros of sensors as unknowns of a fit: y = q + z.

Either z = 0 in the reference, the recording of most samples, or no term of the model is odd: then q and −q move alike,
and this symmetry determines 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.training.arrowhead import dense
from herglotz.training.problems.shooting import ShootingProblem


def reference_of(data: Trajectories) -> int:
    """The recording of most samples, the first of several."""
    return max(range(len(data)), key=lambda b: data.lengths[b])


class WithZeros:
    """A shooting problem with zeros of sensors as further unknowns: (unknowns of the problem, then (B − 1) · n).

    Each recording but the reference has zeros of its own. With `held` parameters, the places of those of odd terms, the
    reference has zeros, too: (B · n). Zeros that are `shared` are n numbers, the same in all recordings. With `grow`,
    (N,), each sample has so many times its zero.
    """

    def __init__(
        self,
        problem: ShootingProblem,
        held: Tensor | None = None,
        *,
        shared: bool = False,
        grow: Tensor | None = None,
    ):
        data, reference = problem.data, reference_of(problem.data)
        own = torch.arange(len(data), device=data.t.device)
        if shared:
            own = torch.zeros_like(own)
        elif held is None:
            own = torch.where(own < reference, own, own - 1).where(own != reference, -1)
        self.problem, self.which, self.held = problem, own[data.trajectory], held
        self.count, self.grow = (int(own.max()) + 1) * problem.n, torch.ones_like(data.t) if grow is None else grow

    @property
    def at_once(self) -> bool:
        """As the problem."""
        return self.problem.at_once

    def cost(self, x: Tensor) -> Tensor:
        """½|r|² with q + z − y as the residuals of the data."""
        return self.problem.cost(self._set(x))

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(cost, JᵀJ, Jᵀr) of all unknowns."""
        rows = x.new_zeros(*self.problem.data.q.shape, self.problem.P + self.problem.d)
        cost, A, b = self.problem.normal_equations(self._set(x), rows=rows)
        if not bool(torch.isfinite(cost)):
            return cost, x.new_zeros(len(x), len(x)), torch.zeros_like(x)
        A = dense(A)
        columns, diagonal, slope = by_zeros(self.problem, rows, self.which, self.grow)
        C = columns.flatten(1)
        A = torch.cat([torch.cat([A, C], 1), torch.cat([C.T, diagonal.flatten().diag()], 1)])
        b = torch.cat([b, slope.flatten()])
        if self.held is not None:
            A[self.held], A[:, self.held], b[self.held] = 0.0, 0.0, 0.0
            A[self.held, self.held] = 1.0
        return cost, A, b

    def _set(self, x: Tensor) -> Tensor:
        """The problem's own unknowns, its zeros being those of x."""
        z = torch.cat([x[-self.count :].reshape(-1, self.problem.n), x.new_zeros(1, self.problem.n)])
        self.problem.zeros = self.grow[:, None] * z[self.which]
        return x[: -self.count]


def by_zeros(
    problem: ShootingProblem,
    rows: Tensor,  # (N, n, P + d)
    which: Tensor,  # (N,)
    grow: Tensor,  # (N,)
) -> tuple[Tensor, Tensor, Tensor]:
    """The parts of (JᵀJ, Jᵀr) that belong to zeros z of sensors: columns (unknowns, Z, n), diagonal, gradient (Z, n).

    They hold where the normal equations of all other unknowns were made last, with these `rows` of J. Sample k has the
    zero `which[k]`, −1 for none, times `grow[k]`.
    """
    assert problem.path is not None
    count = int(which.max()) + 1
    fit = problem._missed_by(problem.path.x)
    by = problem.weight * problem.root_weights(fit) / problem.deviations  # (N, n) ∂r/∂z
    rows = rows * (by * grow[:, None])[..., None]
    segment = problem.grid.segment
    # Samples of a segment have the same zero.
    S, of = problem.grid.segments, torch.full((problem.grid.segments,), -1, device=which.device)
    of[segment] = which
    own = rows.new_zeros(S, *rows.shape[:0:-1]).index_add(0, segment, rows.mT)
    columns = rows.new_zeros(problem.P + S * problem.d, count, problem.n)
    for z in range(count):
        columns[: problem.P, z] = own[of == z, : problem.P].sum(0)
        columns[problem.P :, z] = torch.where((of == z)[:, None, None], own[:, problem.P :], 0.0).flatten(0, 1)
    kept = which >= 0
    zero = rows.new_zeros(count, problem.n)
    diagonal = zero.index_add(0, which[kept], (by * grow[:, None])[kept].square())
    slope = by * problem.root_weights(fit) * fit * grow[:, None]
    return columns, diagonal, zero.index_add(0, which[kept], slope[kept])
