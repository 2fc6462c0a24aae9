"""Base classes of the objectives of a fit: data, robust loss, and the prior of the parameters."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.mechanics import mixed_hessian, partials
from herglotz.models import ContactLagrangian
from herglotz.training.kernel import states_of
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.problems.grid import SegmentGrid, step_inputs
from herglotz.training.problems.prior import Prior
from herglotz.training.problems.robust import loss, root_weights

# Steps of the data for the size of the masses.
MASS_STEPS = 64


class LeastSquares:
    """Σ ρ(r) + prior(θ), with r the residuals over their standard deviations and ρ(r) = ½r² or Student's t.

    An objective derives `cost` and `normal_equations` (`solvers.levenberg_marquardt.SumOfSquares`) from these parts.
    The parameters of `model` are the start; the model is not changed. `sigma` is the standard deviation of the noise of
    q over its `balance`, that of the data unless it is given, `freedom` the ν of Student's t (`robust`; None: least
    squares). `u` are the inputs of all steps, or of the model steps of a grid, where these are known.
    """

    def __init__(
        self,
        model: ContactLagrangian,
        data: Trajectories,
        *,
        sigma: float,
        prior: Prior | None = None,
        freedom: float | None = None,
        grid: SegmentGrid | None = None,
        u: Tensor | None = None,
        balance: Tensor | None = None,  # (n,)
    ):
        self.parameters, self.data, self.n = ParameterVector(model), data, data.dof
        self.P = len(self.parameters.get())
        self.sigma, self.prior, self.freedom = sigma, prior, freedom
        # Standard deviation of each coordinate, in its unit.
        self.deviations = sigma * (data.balance if balance is None else balance)  # (n,)
        self.u = step_inputs(model, data, grid) if u is None else u  # (N, m), or (S, K, m) of a grid

    def loss(self, *residuals: Tensor) -> Tensor:
        """Σ ρ(r) over all residuals, a scalar."""
        return torch.stack([loss(r, self.freedom) for r in residuals]).sum()

    def root_weights(self, r: Tensor) -> Tensor:
        """√w(r), which multiplies rows of J and r in the robust normal equations; 1 for least squares."""
        return root_weights(r, self.freedom)

    def prior_cost(self, theta: Tensor) -> Tensor:
        """The prior's ½|r|², a scalar."""
        return theta.new_zeros(()) if self.prior is None else self.prior.cost(theta)

    def prior_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The prior's (½|r|², JᵀJ, Jᵀr)."""
        if self.prior is None:
            return theta.new_zeros(()), theta.new_zeros(self.P, self.P), theta.new_zeros(self.P)
        return self.prior.normal_equations(theta)


class StatesProblem(LeastSquares, ABC):
    """An objective over the parameters, then states (q, p[, s]) on a grid of model steps.

    s is an unknown only if positions depend on s: a state has d = 2n + 1 numbers then, else 2n. `scale` and `speed` are
    the sizes of q and q̇, `action` that of s.
    """

    def __init__(self, model: ContactLagrangian, data: Trajectories, grid: SegmentGrid, **settings: Any):
        super().__init__(model, data, grid=grid, **settings)
        self.grid = grid
        self.d = states_of(model)
        self.scale, self.speed = (data.q.new_tensor(x) for x in (model.config.scale, model.config.speed))  # (n,)
        self.action = float((self.speed * self.scale).sum())

    def masses_of(self, model: ContactLagrangian) -> Tensor:
        """The ratio p/q̇: the median of h · diag(mixed Hessian) over steps of the data, (n,); 1 if 0 or infinite."""
        steps = self.data.steps()
        some = torch.linspace(0, len(steps.h) - 1, min(MASS_STEPS, len(steps.h)), device=steps.h.device).round().long()
        i, h = steps.index[some], steps.h[some]
        u = self.data.inputs_of_steps(i) if model.inputs else None
        with torch.no_grad():
            P = partials(model if u is None else model.at(u), self.data.q[i], self.data.q[i + 1], 0 * h, h, 2)
            mass = (h[:, None] * mixed_hessian(P).diagonal(0, -2, -1)).abs().median(0).values
        return torch.where(mass.isfinite() & (mass > 0), mass, 1.0)

    def with_s(self, states: Tensor) -> Tensor:
        """States (..., 2n+1) from the unknowns (..., d), with s = 0 if s is no unknown."""
        return torch.cat([states, states.new_zeros(*states.shape[:-1], 2 * self.n + 1 - self.d)], -1)

    @abstractmethod
    def cost(self, x: Tensor) -> Tensor:
        """½|r|², a scalar; infinite if a step has no solution."""

    @abstractmethod
    def normal_equations(self, x: Tensor, *, held: bool = False) -> tuple[Tensor, Any, Tensor]:
        """(½|r|², JᵀJ, Jᵀr); `held`: for the states alone, with fixed parameters."""


class StatesOnly:
    """A problem over parameters and states with fixed parameters: only the states are fitted."""

    def __init__(self, problem: StatesProblem, theta: Tensor):
        self.problem, self.theta = problem, theta

    def full(self, states: Tensor) -> Tensor:
        """All unknowns of the problem."""
        return torch.cat([self.theta, states])

    @property
    def at_once(self) -> bool:
        """As the problem."""
        return getattr(self.problem, "at_once", False)

    def cost(self, x: Tensor) -> Tensor:
        """The cost of the problem with these states."""
        return self.problem.cost(self.full(x))

    def normal_equations(self, x: Tensor) -> tuple[Tensor, Any, Tensor]:
        """The normal equations of the states alone."""
        return self.problem.normal_equations(self.full(x), held=True)
