"""Smoothing: every state of a trajectory is an unknown, and every step has a little noise.

Minimises, over the states X_k = (q, p[, s]) at all nodes (and over the parameters θ, where they are fitted too),

    ½ Σ |q_k − q_data|²/σ² + ½ Σ |(Φ̃_θ(X_k) − X_{k+1})/w|² [+ prior(θ)],

by Gauss–Newton. The matrix is block tridiagonal, bordered by the parameters: the cost grows with the number of samples,
not with its cube. With θ held this is the fixed-interval smoother of Rauch, Tung & Striebel (1965), iterated for a
nonlinear step (Bell 1994). w > 0 lets the motion leave the model a little at every step, so that a push, or an unknown
force, is followed; w → 0 gives the fit of the start states alone.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.mechanics import legendre_minus, partials
from herglotz.models import ContactLagrangian
from herglotz.stepping.block_tridiagonal import diagonal_of_inverse
from herglotz.training.arrowhead import Arrowhead, eliminated, tridiagonal
from herglotz.training.distributed import everywhere, of_first
from herglotz.training.problems.grid import SegmentGrid
from herglotz.training.problems.least_squares import StatesProblem
from herglotz.training.solvers.lifted_newton import all_steps, parameter_derivatives

# Damping of the first step of Levenberg–Marquardt: the stiff steps, not the data, make the diagonal.
DAMPING = 1e-9


class SmoothingProblem(StatesProblem):
    """The sum of squares above, over parameters and the states of all nodes of a grid of whole trajectories.

    `process` is the standard deviation of a step's noise in v, relative to sigma, in the natural units of both. The
    noise in p is that times the mass of each coordinate, the noise in s the same share of the natural size of s, and
    the noise in q h/√3 times that in v, as of a random force. The other settings are those of `LeastSquares`; `freedom`
    is for the residuals of data and steps.
    """

    def __init__(
        self, model: ContactLagrangian, data: Trajectories, grid: SegmentGrid, *, process: float, **settings: Any
    ):
        super().__init__(model, data, grid, **settings)
        self.process, n, d = process, self.n, self.d
        S, M = grid.segments, grid.longest + 1
        node = torch.arange(M, device=data.q.device)
        self.inside = (node <= grid.end[:, None])[..., None].to(data.q)  # (S, M, 1) padding has 0
        self.seen, self.target = data.q.new_zeros(S * M, n), data.q.new_zeros(S * M, n)
        self.seen[grid.node], self.target[grid.node] = 1.0 if data.observed is None else data.observed, data.q
        self.seen, self.target = self.seen.reshape(S, M, n), self.target.reshape(S, M, n)
        # Standard deviations that an unknown force adds in a step: to v, to q by way of v, to p, and to s.
        v = (self.deviations * self.speed / self.scale).expand(*grid.h.shape, n)
        s = (self.sigma * v.new_tensor([self.action]) / self.scale.max()).expand(*grid.h.shape, 1)
        self.mass = self.masses_of(model)  # (n,)
        self.w = process * torch.cat([grid.h[..., None] / 3**0.5 * v, self.mass * v, s], -1)[..., :d]  # (S, K, d)
        self._stepped_at: tuple[Tensor, tuple[Tensor, Tensor] | None] | None = None

    def start(self) -> Tensor:
        """Positions on straight lines between samples, momenta by FL⁻, s = 0; (P + S·M·d,) with the parameters."""
        theta, grid, n, t, q = self.parameters.get(), self.grid, self.n, self.data.t, self.data.q
        S, K = grid.h.shape
        # The share of its recorded step at which each model step begins; the padding rests at the last sample.
        share = (grid.part - grid.h / (2 * (t[grid.row + 1] - t[grid.row])))[..., None]
        inside = torch.arange(K, device=q.device) < grid.end[:, None]
        last = q[grid.row[:, -1:] + 1]
        x = q.new_zeros(S, K + 1, self.d)
        x[:, :-1, :n] = torch.where(inside[..., None], q[grid.row] * (1 - share) + q[grid.row + 1] * share, last)
        x[:, -1:, :n] = last
        with torch.no_grad():
            _, p, _ = legendre_minus(self.parameters.at(theta, self.u), x[:, :-1, :n], x[:, 1:, :n], 0 * grid.h, grid.h)
        # The last nodes and the padding have the momentum of the last step.
        step = torch.arange(K + 1, device=p.device).minimum(grid.end[:, None] - 1)
        x[..., n : 2 * n] = p[torch.arange(S, device=p.device)[:, None], step]
        return torch.cat([theta, x.flatten()])

    def unpack(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Parameters (P,) and states (S, M, d)."""
        return x[: self.P], x[self.P :].reshape(self.grid.segments, -1, self.d)

    def cost(self, x: Tensor) -> Tensor:
        """½|r|²; infinite where a step has no solution."""
        stepped = self._stepped(x)
        if stepped is None:
            return x.new_full((), torch.inf)
        theta, states = self.unpack(x)
        fit, defect = self._residuals(states, stepped[0])
        return self.loss(fit, defect) + self._anchor(states).square().sum() / 2 + self.prior_cost(theta)

    def normal_equations(self, x: Tensor, *, held: bool = False) -> tuple[Tensor, Arrowhead, Tensor]:
        """(cost, JᵀJ, Jᵀr). `held`: of the states alone, θ as it is."""
        theta, states = self.unpack(x)
        stepped, (S, M, d), P = self._stepped(x), states.shape, 0 if held else self.P
        diagonal, upper = x.new_zeros(2, S, M, d, d)
        border, gradient = x.new_zeros(S, M, d, P), x.new_zeros(S, M, d)
        if not everywhere(stepped is not None) or stepped is None:
            unknown = x.new_zeros(P + gradient.numel())
            return x.new_full((), torch.inf), self._matrix(x.new_zeros(P, P), border, diagonal, upper), unknown
        y, A = stepped[0], stepped[1][..., :d, :d]
        fit, defect = self._residuals(states, y)
        by_fit = self.seen * self.root_weights(fit) / self.deviations  # (S, M, n)
        by_step = self.inside[:, 1:] * self.root_weights(defect) / self.w  # (S, K, d)
        weighted, weight = by_step * self.root_weights(defect) * defect, by_step.square()[..., None]
        WA = weight * A
        diagonal[..., : self.n, : self.n] += torch.diag_embed(by_fit.square())
        diagonal[:, :-1] += A.mT @ WA
        diagonal[:, 1:] += torch.diag_embed(weight[..., 0])
        # Padding stays where it is.
        diagonal += torch.diag_embed((1 - self.inside).expand(-1, -1, d))
        upper[:, :-1] = -WA.mT
        gradient[..., : self.n] = by_fit * self.root_weights(fit) * fit
        gradient[:, :-1] += (A.mT @ weighted[..., None])[..., 0]
        gradient[:, 1:] -= weighted
        if d > 2 * self.n:
            diagonal[:, 0, -1, -1] += 1 / self.action**2
            gradient[:, 0, -1] += self._anchor(states) / self.action
        B, of_prior = A.new_zeros(S, M - 1, d, 0), (self.prior_cost(theta), 0.0, 0.0)
        if not held:
            L_d = self.parameters.at(theta, self.u)
            B = parameter_derivatives(L_d, self.with_s(states), y[..., : self.n], A, self.grid.h)
            of_prior = self.prior_equations(theta)
        WB = weight * B
        border[:, :-1] += A.mT @ WB
        border[:, 1:] -= WB
        cost = self.loss(fit, defect) + self._anchor(states).square().sum() / 2 + of_prior[0]
        corner = torch.einsum("skdp,skdr->pr", B, WB) + of_prior[1]
        top = torch.einsum("skdp,skd->p", B, weighted) + of_prior[2]
        matrix = self._matrix(*of_first(corner, border, diagonal, upper))
        return cost, matrix, torch.cat([top, gradient.flatten()])

    def _matrix(self, corner: Tensor, border: Tensor, diagonal: Tensor, upper: Tensor) -> Arrowhead:
        """JᵀJ from the blocks of all nodes of S trajectories, (S, M, d, ·); the trajectories are eliminated at once."""
        S = self.grid.segments

        def at_once(diagonal: Tensor, upper: Tensor, columns: Tensor) -> Tensor | None:
            found = eliminated(*(x.unflatten(0, (S, -1)) for x in (diagonal, upper, columns)))
            return None if found is None else found.flatten(0, 1)

        return Arrowhead(corner, border.flatten(0, 1), diagonal.flatten(0, 1), upper.flatten(0, 1), at_once)

    def variances(self, x: Tensor) -> Tensor:
        """Variances of the states at the samples for known parameters, (N, d)."""
        _, matrix, _ = self.normal_equations(x, held=True)
        diagonal, upper = (y.unflatten(0, (self.grid.segments, -1)) for y in (matrix.blocks, matrix.upper))
        return self.grid.at_samples(diagonal_of_inverse(tridiagonal(diagonal, upper)))

    def misfit(self, x: Tensor) -> Tensor:
        """Q − q_data over the balance of the coordinates at every sample, (N, n)."""
        return (self.grid.at_samples(self.unpack(x)[1][..., : self.n]) - self.data.q) / self.data.balance

    def defects(self, x: Tensor) -> Tensor:
        """(Φ̃(X_k) − X_{k+1})/w of every step, (S, K, d); 0 where there is none."""
        stepped = self._stepped(x)
        assert stepped is not None
        return self._residuals(self.unpack(x)[1], stepped[0])[1]

    def states(self, x: Tensor) -> Tensor:
        """States (q, p, s) at every sample, (N, 2n+1); where s does not enter the motion, s is summed from 0."""
        theta, states = self.unpack(x)
        full = self.with_s(states)
        if self.d == 2 * self.n:
            with torch.no_grad():
                L_d = self.parameters.at(theta, self.u)
                P = partials(L_d, full[:, :-1, : self.n], full[:, 1:, : self.n], 0 * self.grid.h, self.grid.h)
            # L_d = L_d(s = 0) + (c − 1) s
            for k in range(self.grid.longest):
                full[:, k + 1, -1] = P.c[:, k] * full[:, k, -1] + P.L[:, k]
        return self.grid.at_samples(full)

    def _stepped(self, x: Tensor) -> tuple[Tensor, Tensor] | None:
        """Φ̃ of every state but the last, and its derivative."""
        if self._stepped_at is None or not torch.equal(self._stepped_at[0], x):
            theta, states = self.unpack(x)
            with torch.no_grad():
                stepped = all_steps(self.parameters.at(theta, self.u), self.with_s(states), self.grid.h)
            # The normal equations of an accepted step use the solution that its cost has made.
            self._stepped_at = x.clone(), stepped
        return self._stepped_at[1]

    def _residuals(self, states: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Residuals of the data, (S, M, n), and of the steps, (S, K, d); 0 where there is no sample or no step."""
        fit = self.seen * (states[..., : self.n] - self.target) / self.deviations
        return fit, self.inside[:, 1:] * (y[..., : self.d] - states[:, 1:]) / self.w

    def _anchor(self, states: Tensor) -> Tensor:
        """Residuals of the first s of each trajectory, (S,); none where s does not enter the motion."""
        return states[:, 0, 2 * self.n :].flatten() / self.action
