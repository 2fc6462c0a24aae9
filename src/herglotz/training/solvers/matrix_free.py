"""Gauss–Newton without a matrix: for models of more parameters than JᵀJ has room for.

Products JᵀJ v come from backward derivatives of the residuals, chunk by chunk and shared by the processes; the damped
equations are solved by conjugate gradients. J. Martens, "Deep learning via Hessian-free optimization", ICML 2010.

A loose solution costs more than it saves: solved to 1e-2 only, the search on exact data needs more than twice the
steps; solved to 1e-4 it takes as many as with a matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.training.distributed import add_over_processes, is_first, of_first
from herglotz.training.problems.one_step import ResidualProblem
from herglotz.training.problems.robust import loss, root_weights

DENSE = 5000  # parameters up to which JᵀJ is built
PROBES = 16  # of the diagonal
ROOM = 100  # directions of the conjugate gradients that memory is taken for at a time


class Linearised:
    """Residuals at one point with both products of their Jacobian J, for as long as the graph of derivatives is kept.

    J v is the derivative of u ↦ Jᵀu along v, twice backward: torch's forward mode lacks some derivatives.
    """

    def __init__(self, residuals: Callable[[Tensor], Tensor], x: Tensor):
        with torch.enable_grad():
            self.x = x.detach().requires_grad_()
            self.graph = residuals(self.x)
            self.u = torch.zeros_like(self.graph, requires_grad=True)
            (self.turned,) = torch.autograd.grad(self.graph, self.x, self.u, create_graph=True)

    @property
    def r(self) -> Tensor:
        """The residuals, (R,)."""
        return self.graph.detach()

    def back(self, u: Tensor) -> Tensor:
        """Jᵀu, (P,)."""
        return torch.autograd.grad(self.graph, self.x, u, retain_graph=True)[0]

    def along(self, v: Tensor) -> Tensor:
        """J v, (R,)."""
        return torch.autograd.grad(self.turned, self.u, v, retain_graph=True)[0]


@dataclass(frozen=True)
class Piece:
    """Some of the residuals: as a function, linearised where that is kept, and their weights in the robust loss."""

    residuals: Callable[[Tensor], Tensor]
    kept: Linearised | None
    weight: Tensor  # (R,)


@dataclass(frozen=True)
class Curvature:
    """JᵀJ at one point, by its products."""

    x: Tensor  # (P,)
    pieces: list[Piece]  # this process's share of the residuals
    estimate: Tensor  # (P,) of the diagonal

    def __matmul__(self, v: Tensor) -> Tensor:
        """JᵀJ v, (P,)."""
        out = torch.zeros_like(v)
        for piece in self.pieces:
            J = piece.kept or Linearised(piece.residuals, self.x)
            out += J.back(piece.weight * J.along(v))
        add_over_processes(out)
        return out

    def diagonal(self) -> Tensor:
        """An estimate of the diagonal, (P,): the mean of (Jᵀz)² over random signs z, never negative."""
        return self.estimate

    def solve(self, b: Tensor, damping: Tensor, *, tol: float = 1e-4, iterations: int = 1000) -> Tensor | None:
        """(JᵀJ + D) y = b by conjugate gradients, preconditioned by D, to |rest| ≤ tol |b| in D⁻¹'s norm.

        None where a product is not finite. Every rest is made orthogonal to all before it: rounding, which differs with
        the number of processes, would otherwise grow to 1e-6 of y, and cost more products than this does.
        """
        root = damping.sqrt()
        y, rest = torch.zeros_like(b), b / root
        direction, size = rest, rest @ rest
        enough, before = tol * tol * float(size), b.new_empty(0, len(b))
        for k in range(iterations):
            if not float(size) > enough:  # nan too
                break
            if k == len(before):
                before = torch.cat([before, before.new_empty(ROOM, len(b))])
            before[k] = rest / size.sqrt()
            product = (self @ (direction / root)) / root + direction
            length = size / (direction @ product)
            y, rest = y + length * direction, rest - length * product
            for _ in range(2):  # twice is enough (Giraud, Langou & Rozložník 2005)
                rest = rest - before[: k + 1].T @ (before[: k + 1] @ rest)
            last, (size,) = size, of_first(rest @ rest)  # every process stops at the same product
            direction = rest + size / last * direction
        (y,) = of_first(y / root)
        return y if bool(torch.isfinite(y).all()) else None


class MatrixFree:
    """A residual problem whose normal equations hold `Curvature` for a matrix; s may not enter the motion.

    The derivatives of the first chunk are kept between products, those of further ones are made again by each: memory
    does not grow with the data.
    """

    def __init__(self, problem: ResidualProblem):
        assert not problem.carries_s  # the recurrence of s has a Jacobian of its own
        self.problem, self.signs = problem, _signs(len(problem.triples), problem.data.dof)

    def cost(self, x: Tensor) -> Tensor:
        """See `levenberg_marquardt.SumOfSquares`."""
        return self.problem.cost(x)

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Curvature, Tensor]:
        """(cost, JᵀJ by its products, Jᵀr)."""
        pieces: list[Piece] = []
        cost, gradient = x.new_zeros(()), torch.zeros_like(x)
        probes, of_prior = x.new_zeros(PROBES, len(x)), torch.zeros_like(x)
        for part, residuals in self.problem.pieces():
            J = Linearised(residuals, x)
            weight = root_weights(J.r, self.problem.freedom).square()
            cost, gradient = cost + loss(J.r, self.problem.freedom), gradient + J.back(weight * J.r)
            # Summed before they are squared: the estimate does not depend on chunks, nor on how many processes.
            signs = self.signs[:, part.cpu()].flatten(1).to(weight)
            probes += torch.stack([J.back(weight.sqrt() * z) for z in signs])
            pieces.append(Piece(residuals, None if pieces else J, weight))
        prior = self.problem.prior
        if prior is not None and is_first():
            J = Linearised(prior.residuals, x)
            cost, gradient = cost + J.r.square().sum() / 2, gradient + J.back(J.r)
            of_prior = torch.stack([J.back(z) for z in _signs(len(J.r)).to(x)]).square().mean(0)
            pieces.append(Piece(prior.residuals, J, torch.ones_like(J.r)))
        add_over_processes(cost, gradient, probes, of_prior)
        return cost, Curvature(x, pieces, probes.square().mean(0) + of_prior), gradient


def _signs(*shape: int) -> Tensor:
    """Random signs of the probes, (PROBES, *shape), always the same."""
    make = torch.Generator().manual_seed(0)
    return torch.randint(0, 2, (PROBES, *shape), generator=make, dtype=torch.int8) * 2 - 1
