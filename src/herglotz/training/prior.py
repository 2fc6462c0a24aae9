"""What a model is expected to be before it sees data: near its baseline."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import functional_call, jacrev

from herglotz.models import ContactLagrangian
from herglotz.models.network import position_jet
from herglotz.training.flat import FlatModel


class Prior:
    """Gaussian prior, as residuals that join a least-squares problem.

    * The force of the potential's network, −∂V_net/∂q, on a grid over the data, is N(0, (τ F)²) with F the baseline's
      typical force: `departure` = τ. The grid's residuals share one weight, so that τ does not depend on its size.
    * Every network weight is N(0, `weight`²): weak, it only keeps unseen directions from drifting.
    * The damping rate is N(its start, `rate_spread`²).
    """

    def __init__(
        self,
        model: ContactLagrangian,
        low: Tensor,  # (n,) lowest position in the data
        high: Tensor,  # (n,) highest
        *,
        departure: float | None,
        weight: float = 10.0,
        rate_spread: float = 1.0,
        grid: int = 32,
    ):
        self.flat = FlatModel(model)
        theta = self.flat.get()
        self.departure = departure if model.potential.network is not None else None
        networks = ("potential.network", "damping.network", "correction")
        self.weight_index = torch.cat([self.flat.index(prefix) for prefix in networks])
        self.rate_index = self.flat.index("damping.rate")
        self.rate_start, self.rate_spread, self.weight = theta[self.rate_index], rate_spread, weight
        n = len(low)
        if n == 1:
            self.grid = torch.linspace(0, 1, grid, dtype=low.dtype, device=low.device)[:, None] * (high - low) + low
        else:
            points = torch.quasirandom.SobolEngine(n, seed=0).draw(grid * n).to(low)
            self.grid = points * (high - low) + low
        self.force = float(self._baseline_force().square().mean().sqrt())

    def residuals(self, theta: Tensor) -> Tensor:
        """Prior residuals, (m,)."""
        parts = [theta[self.weight_index] / self.weight, (theta[self.rate_index] - self.rate_start) / self.rate_spread]
        if self.departure is not None:
            parts.append(self._network_force(theta).reshape(-1) / (self.departure * self.force))
        return torch.cat(parts)

    def cost(self, theta: Tensor) -> Tensor:
        """½|residuals|²."""
        return self.residuals(theta).square().sum() / 2

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(½|r|², JᵀJ, Jᵀr) of the prior alone."""
        r, J = self.residuals(theta), jacrev(self.residuals)(theta)
        return r.square().sum() / 2, J.T @ J, J.T @ r

    def _baseline_force(self) -> Tensor:
        with torch.no_grad():
            return self.flat.model.potential.baseline(position_jet(self.grid, 1)).gradient

    def _network_force(self, theta: Tensor) -> Tensor:
        return functional_call(_Departure(self.flat.model), self._prefixed(theta), (self.grid,))

    def _prefixed(self, theta: Tensor) -> dict[str, Tensor]:
        return {f"model.{name}": value for name, value in self.flat.unflatten(theta).items()}


class _Departure(torch.nn.Module):
    """The network part of the potential's gradient, as a module so that functional_call reaches it."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.model = model

    def forward(self, q: Tensor) -> Tensor:
        jet = self.model.potential.departure(position_jet(q, 1))
        assert jet is not None
        return jet.gradient
