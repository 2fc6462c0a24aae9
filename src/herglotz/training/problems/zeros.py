"""Zeros of sensors as unknowns of a fit: y = q + z."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from herglotz.training.arrowhead import Arrowhead
from herglotz.training.problems.shooting import ShootingProblem

# Standard deviation of the prior of a zero, over the balance of its coordinate. A zero that positions do not determine
# stays 0.
PRIOR = 10.0


class WithZeros:
    """A shooting problem with zeros of sensors as further unknowns: parameters (P,), zeros (Z · n,), then states.

    Each recording has zeros of its own, Z = B. Zeros that are `shared` are n numbers, the same in all recordings. With
    `held` parameters only zeros and states are fitted. With `grow`, (N,), each sample has so many times its zero.
    """

    def __init__(
        self,
        problem: ShootingProblem,
        *,
        shared: bool = False,
        held: bool = False,
        grow: Tensor | None = None,
    ):
        data = problem.data
        self.which = torch.zeros_like(data.trajectory) if shared else data.trajectory
        self.problem, self.held = problem, held
        self.count, self.grow = (
            (1 if shared else len(data)) * problem.n,
            torch.ones_like(data.t) if grow is None else grow,
        )
        self.deviations = (PRIOR * data.balance).repeat(self.count // problem.n)

    @property
    def at_once(self) -> bool:
        """As the problem."""
        return self.problem.at_once

    def start(self, x: Tensor, zeros: Tensor | None = None) -> Tensor:
        """The unknowns x of the problem with these zeros (Z, n), else 0; positions are readings less the zeros."""
        problem, x = self.problem, x.clone()
        zeros = x.new_zeros(self.count // problem.n, problem.n) if zeros is None else zeros
        of = self.which[problem.grid.start_sample]
        x[problem.P :].unflatten(0, (-1, problem.d))[:, : problem.n] -= zeros[of]
        return torch.cat([x[: problem.P], zeros.flatten(), x[problem.P :]])

    def zeros_of(self, x: Tensor) -> Tensor:
        """The zeros (Z · n,) among the unknowns."""
        return x[self.problem.P : self.problem.P + self.count]

    def cost(self, x: Tensor) -> Tensor:
        """½|r|² with q + z − y as the residuals of the data, and the prior of the zeros."""
        return self.problem.cost(self._set(x)) + (self.zeros_of(x) / self.deviations).square().sum() / 2

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Arrowhead, Tensor]:
        """(cost, JᵀJ, Jᵀr) of all unknowns."""
        problem, P = self.problem, self.problem.P
        rows = x.new_zeros(*problem.data.q.shape, P + problem.d)
        cost, A, b = problem.normal_equations(self._set(x), rows=rows)
        zeros = self.zeros_of(x) / self.deviations
        finite = bool(torch.isfinite(cost))
        by_theta, border, diagonal, slope = self._by_zeros(rows) if finite else self._nothing(A)
        diagonal, slope = diagonal + self.deviations**-2, slope + zeros / self.deviations
        if self.held:
            A.corner.copy_(torch.eye(P, dtype=x.dtype, device=x.device))
            A.border.zero_()
            by_theta, b[:P] = torch.zeros_like(by_theta), 0.0
        corner = torch.cat([torch.cat([A.corner, by_theta], 1), torch.cat([by_theta.T, diagonal.diag()], 1)])
        whole = replace(A, corner=corner, border=torch.cat([A.border, border], -1))
        return cost + zeros.square().sum() / 2, whole, torch.cat([b[:P], slope, b[P:]])

    def _set(self, x: Tensor) -> Tensor:
        """The problem's own unknowns, its zeros being those of x."""
        problem = self.problem
        problem.zeros = self.grow[:, None] * self.zeros_of(x).reshape(-1, problem.n)[self.which]
        return torch.cat([x[: problem.P], x[problem.P + self.count :]])

    def _nothing(self, A: Arrowhead) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The parts of `_by_zeros` where a step fails: 0."""
        zero, (S, d) = A.corner.new_zeros, A.border.shape[:2]
        return zero(len(A.corner), self.count), zero(S, d, self.count), zero(self.count), zero(self.count)

    def _by_zeros(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The parts of (JᵀJ, Jᵀr) that belong to the zeros, of which there are C = Z · n.

        These are the columns by parameters (P, C) and by states (S, d, C), the diagonal and the gradient (C,). They
        hold where the normal equations of all other unknowns were made last, with these `rows` (N, n, P + d) of J.
        """
        problem, grow = self.problem, self.grow[:, None]
        assert problem.path is not None
        P, n, S, d = problem.P, problem.n, problem.grid.segments, problem.d
        fit = problem._missed_by(problem.path.x)
        # ∂r/∂q, (N, n)
        by = problem.weight * problem.root_weights(fit) / problem.deviations
        rows = (rows * (by * grow)[..., None]).mT  # (N, P + d, n)
        by_theta = rows.new_zeros(self.count // n, P, n).index_add(0, self.which, rows[:, :P])
        # Samples of a segment have the same zero.
        border = rows.new_zeros(S, d, self.count // n, n)
        own = rows.new_zeros(S, d, n).index_add(0, problem.grid.segment, rows[:, P:])
        border[torch.arange(S), :, self.which[problem.grid.start_sample]] = own
        sums = rows.new_zeros(2, self.count // n, n)
        sums[0].index_add_(0, self.which, (by * grow).square())
        sums[1].index_add_(0, self.which, by * problem.root_weights(fit) * fit * grow)
        diagonal, slope = sums.flatten(1)
        return by_theta.transpose(0, 1).flatten(1), border.flatten(2), diagonal, slope
