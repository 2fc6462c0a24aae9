"""Zeros of sensors as unknowns of a fit: y = q + z, with z = 0 in the reference, the recording of most samples."""

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

    Each recording but the reference has zeros of its own. Zeros that are `shared` are n numbers, the same in all
    recordings. With `held` parameters only zeros and states are fitted. With `grow`, (N,), each sample has so many
    times its zero.
    """

    def __init__(
        self,
        problem: ShootingProblem,
        *,
        shared: bool = False,
        held: bool = False,
        grow: Tensor | None = None,
    ):
        data, reference = problem.data, reference_of(problem.data)
        b = torch.arange(len(data), device=data.t.device)
        others = torch.where(b < reference, b, b - 1).where(b != reference, -1)
        own = torch.zeros_like(b) if shared else others
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
        columns, diagonal, slope = self._by_zeros(rows)
        C = columns.flatten(1)
        A = torch.cat([torch.cat([A, C], 1), torch.cat([C.T, diagonal.flatten().diag()], 1)])
        b = torch.cat([b, slope.flatten()])
        if self.held:
            own = slice(self.problem.P)
            A[own], A[:, own], b[own] = 0.0, 0.0, 0.0
            A[own, own].diagonal().fill_(1.0)
        return cost, A, b

    def _set(self, x: Tensor) -> Tensor:
        """The problem's own unknowns, its zeros being those of x."""
        z = torch.cat([x[-self.count :].reshape(-1, self.problem.n), x.new_zeros(1, self.problem.n)])
        self.problem.zeros = self.grow[:, None] * z[self.which]
        return x[: -self.count]

    def _by_zeros(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The parts of (JᵀJ, Jᵀr) that belong to the zeros: columns (unknowns, Z, n), diagonal and gradient (Z, n).

        They hold where the normal equations of all other unknowns were made last, with these `rows` (N, n, P + d) of J.
        """
        problem, which, grow = self.problem, self.which, self.grow[:, None]
        assert problem.path is not None
        count, segments = self.count // problem.n, problem.grid.segments
        fit = problem._missed_by(problem.path.x)
        by = problem.weight * problem.root_weights(fit) / problem.deviations  # (N, n) ∂r/∂q
        rows = rows * (by * grow)[..., None]
        # Samples of a segment have the same zero.
        of = torch.full((segments,), -1, device=which.device)
        of[problem.grid.segment] = which
        own = rows.new_zeros(segments, *rows.shape[:0:-1]).index_add(0, problem.grid.segment, rows.mT)
        columns = rows.new_zeros(problem.P + segments * problem.d, count, problem.n)
        for z in range(count):
            columns[: problem.P, z] = own[of == z, : problem.P].sum(0)
            columns[problem.P :, z] = torch.where((of == z)[:, None, None], own[:, problem.P :], 0.0).flatten(0, 1)
        kept = which >= 0
        zero = rows.new_zeros(count, problem.n)
        diagonal = zero.index_add(0, which[kept], (by * grow)[kept].square())
        slope = by * problem.root_weights(fit) * fit * grow
        return columns, diagonal, zero.index_add(0, which[kept], slope[kept])
