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

    * The force of the potential's network, −∂V_net/∂q, has over the range of the data an RMS of N(0, (τ F)²), with F
      the RMS force of the baseline: `departure` = τ. (Many grid points share that one residual's weight.)
    * Every network weight is N(its start, `weight`²): weak, it only keeps unseen directions from drifting. (Centred
      at 0 it would switch the network off: behind a zero-initialised last layer nothing else holds the first one.)
    * The damping rate and the drag coefficients (per unit of position) are N(their start, `rate_spread`²).
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
        self.rate_index = torch.cat([self.flat.index("damping.rate"), self.flat.index("damping.drag")])
        self.start, self.rate_spread, self.weight = theta, rate_spread, weight
        n = len(low)
        if n == 1:
            self.grid = torch.linspace(0, 1, grid, dtype=low.dtype, device=low.device)[:, None] * (high - low) + low
        else:
            points = torch.quasirandom.SobolEngine(n, seed=0).draw(grid * n).to(low)
            self.grid = points * (high - low) + low
        force = float(self._baseline_force().square().mean().sqrt())
        self.force = force if force > 0 else 1.0

    def residuals(self, theta: Tensor) -> Tensor:
        """Prior residuals, (m,)."""
        moved = theta - self.start
        parts = [moved[self.weight_index] / self.weight, moved[self.rate_index] / self.rate_spread]
        if self.departure is not None:
            force = self._network_force(theta)
            parts.append(force.reshape(-1) / (self.departure * self.force * force.numel() ** 0.5))
        return torch.cat(parts)

    def cost(self, theta: Tensor) -> Tensor:
        """½|residuals|²."""
        return self.residuals(theta).square().sum() / 2

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(½|r|², JᵀJ, Jᵀr) of the prior alone."""
        r, J = self.residuals(theta), jacrev(self.residuals)(theta)
        return r.square().sum() / 2, J.T @ J, J.T @ r

    def log_determinant(self, theta: Tensor) -> Tensor:
        """log det of the prior's precision over the parameters it speaks about (for the evidence)."""
        J = jacrev(self.residuals)(theta)
        A = (J.T @ J)[self._covered][:, self._covered]
        return torch.linalg.slogdet(A).logabsdet

    @property
    def _covered(self) -> Tensor:
        return torch.cat([self.weight_index, self.rate_index])

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
