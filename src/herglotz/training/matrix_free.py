"""Gauss–Newton without a matrix: for models of more parameters than JᵀJ has room for.

Products JᵀJ v come from backward derivatives of the residuals, chunk by chunk and shared by the
processes; the damped equations are solved by conjugate gradients, cut short. J. Martens, "Deep learning via
Hessian-free optimization", ICML 2010.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.func import vjp

from herglotz.training.distributed import add_over_processes, is_first
from herglotz.training.residual import ResidualProblem
from herglotz.training.robust import loss, root_weights

DENSE = 5000  # parameters up to which JᵀJ is built
PROBES = 16  # of the diagonal
Piece = tuple[Callable[[Tensor], Tensor], Tensor]  # residuals as a function of x, and the weights of the robust loss


@dataclass(frozen=True)
class Curvature:
    """JᵀJ at one point, by its products."""

    x: Tensor  # (P,)
    pieces: list[Piece]  # this process's share of the residuals

    def __matmul__(self, v: Tensor) -> Tensor:
        """JᵀJ v, (P,)."""
        out = torch.zeros_like(v)
        for residuals, by in self.pieces:
            back = vjp(residuals, self.x)[1]
            # J v as the derivative of u ↦ Jᵀu along v, twice backward: torch's forward mode lacks some.
            turned = vjp(lambda u, f=residuals: vjp(f, self.x)[1](u)[0], torch.zeros_like(by))[1](v)[0]
            out += back(by.square() * turned)[0]
        add_over_processes(out)
        return out

    def diagonal(self) -> Tensor:
        """An estimate of the diagonal, (P,): the mean of (Jᵀz)² over random signs z, never negative."""
        make = torch.Generator().manual_seed(0)
        out = torch.zeros_like(self.x)
        for residuals, by in self.pieces:
            back = vjp(residuals, self.x)[1]
            draws = torch.randint(0, 2, (PROBES, *by.shape), generator=make).to(by) * 2 - 1
            out += sum(back(by * z)[0].square() for z in draws) / PROBES
        add_over_processes(out)
        return out

    def solve(self, b: Tensor, damping: Tensor, *, tol: float = 1e-2, iterations: int = 100) -> Tensor | None:
        """(JᵀJ + D) y = b by conjugate gradients, preconditioned by D, to |rest| ≤ tol |b| in D's norm.

        None where a product is not finite.
        """
        y, rest = torch.zeros_like(b), b.clone()
        z = rest / damping
        direction, size = z, rest @ z
        enough = tol * tol * float(size)
        for _ in range(iterations):
            if float(size) <= enough:
                break
            product = self @ direction + damping * direction
            length = size / (direction @ product)
            y, rest = y + length * direction, rest - length * product
            z = rest / damping
            before, size = size, rest @ z
            direction = z + size / before * direction
        return y if bool(torch.isfinite(y).all()) else None


class MatrixFree:
    """A residual problem whose normal equations hold `Curvature` for a matrix; s may not enter the motion."""

    def __init__(self, problem: ResidualProblem):
        assert not problem.coupled  # the recurrence of s has a Jacobian of its own
        self.problem = problem

    def cost(self, x: Tensor) -> Tensor:
        """See `LeastSquares`."""
        return self.problem.cost(x)

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Curvature, Tensor]:
        """(cost, JᵀJ by its products, Jᵀr)."""
        cost, gradient, pieces = x.new_zeros(()), torch.zeros_like(x), []
        for residuals in self.problem.pieces():
            r, back, *_ = vjp(residuals, x)
            by = root_weights(r, self.problem.freedom)
            cost, gradient = cost + loss(r, self.problem.freedom), gradient + back(by.square() * r)[0]
            pieces.append((residuals, by))
        prior = self.problem.prior
        if prior is not None and is_first():
            r, back, *_ = vjp(prior.residuals, x)
            cost, gradient = cost + r.square().sum() / 2, gradient + back(r)[0]
            pieces.append((prior.residuals, torch.ones_like(r)))
        cost, gradient = cost.detach(), gradient.detach()
        add_over_processes(cost, gradient)
        return cost, Curvature(x, pieces), gradient
