"""What a model is expected to be before it sees data: near its baseline."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.func import functional_call, jacrev

from herglotz.models import ContactLagrangian
from herglotz.models.jet import coordinates
from herglotz.models.terms import AffineDamping
from herglotz.training.baseline import Baseline
from herglotz.training.parameter_vector import ParameterVector

# Parameters of order one, by the beginning of their names.
NETWORKS = ("potential.network", "damping.network", "correction", "kinetic.network", "action.log_slope",
            "action.weight", "action.bias")  # fmt: skip
WIDTH = 0.5  # of the logarithms of dry friction's widths: below what a step resolves, they only make it stiff
BREAKAWAY = 0.01  # of Stribeck's excess force, in forces of the baseline: a broad one would replace viscous friction


class Prior:
    """Gaussian prior, as residuals that join a least-squares problem.

    * The force of the potential's network, −∂V_net/∂q, has over the range of the data an RMS of N(0, (τ F)²), with F
      the RMS force of the baseline: `departure` = τ. (Many grid points share that one residual's weight.)
    * The damping's network G(q̄, v) (affine level) has there an RMS of N(0, (τ r)²), r the typical rate of the motion.
    * Every network weight is N(its start, `weight`²): weak, it only keeps unseen directions from drifting. (Centred
      at 0 it would switch the network off: behind a zero-initialised last layer nothing else holds the first one.)
    * The damping rate, the drag coefficients (per unit of position), the rates of the full level's units and viscous
      friction (the first mass is 1) are N(their start, `rate_spread`²); dry friction is N(0, (`rate_spread` speed)²),
      its excess at breakaway N(0, (0.01 F)²) and the logarithms of its widths N(their start, 0.5²).
    * Terms by name (`herglotz.models.Term`) state their own spread.
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
        grid: int = 64,
    ):
        self.parameters = ParameterVector(model)
        theta = self.parameters.get()
        self.departure = departure
        self.weight_index = self._index(*NETWORKS)
        self.rate_index = self._index("damping.rate", "damping.drag", "action.rate", "friction.viscous")
        self.width_index = self._index("friction.log")
        self.force_index = self._index("friction.coulomb")
        self.breakaway_index = self._index("friction.breakaway")
        own = [(f"more.{i}.", term.spread) for i, term in enumerate(model.named_terms) if term.spread is not None]
        self.own = [(self._index(name), spread) for name, spread in own]
        self.start, self.rate_spread, self.weight = theta, rate_spread, weight
        unit = torch.quasirandom.SobolEngine(2 * len(low), seed=0, scramble=True).draw(grid * len(low)).to(low)
        speed = low.new_tensor(model.config.speed)
        self.grid = unit[:, : len(low)] * (high - low) + low
        self.velocity = (2 * unit[:, len(low) :] - 1) * speed
        self.typical_rate = float((speed / low.new_tensor(model.config.scale)).min())
        force = float(self._baseline_force().square().mean().sqrt())
        self.force = force if force > 0 else 1.0

    def residuals(self, theta: Tensor) -> Tensor:
        """Prior residuals, (m,)."""
        moved = theta - self.start
        parts = [moved[self.weight_index] / self.weight, moved[self.rate_index] / self.rate_spread]
        if len(self.force_index):
            parts.append(moved[self.force_index] / (self.rate_spread * max(self.parameters.model.config.speed)))
            parts.append(moved[self.breakaway_index] / (BREAKAWAY * self.force))
            parts.append(moved[self.width_index] / WIDTH)
        parts += [moved[index] / spread for index, spread in self.own]
        if self.departure is not None:
            parts += [x / (self.departure * x.numel() ** 0.5) for x in self._departures(theta)]
        return torch.cat(parts)

    def cost(self, theta: Tensor) -> Tensor:
        """½|residuals|²."""
        return self.residuals(theta).square().sum() / 2

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(½|r|², JᵀJ, Jᵀr) of the prior alone."""
        J, r = jacrev(lambda x: (r := self.residuals(x), r), has_aux=True)(theta)
        return r.square().sum() / 2, J.T @ J, J.T @ r

    def _index(self, *prefixes: str) -> Tensor:
        return torch.cat([self.parameters.index(prefix) for prefix in prefixes])

    def _baseline_force(self) -> Tensor:
        with torch.no_grad():
            potential = self.parameters.model.potential
            own = potential.baseline(coordinates(self.grid, 1)).gradient
            if potential.features is None or bool(own.any()):
                return own
            return potential.features(self.grid, 1).gradient  # the potential is made of features alone

    def _departures(self, theta: Tensor) -> list[Tensor]:
        """Network outputs on the grid, each relative to its natural size."""
        named = {f"model.{name}": value for name, value in self.parameters.unflatten(theta).items()}
        force, rate = functional_call(_Departures(self.parameters.model), named, (self.grid, self.velocity))
        parts = [] if force is None else [force.reshape(-1) / self.force]
        return parts if rate is None else [*parts, rate / self.typical_rate]


def prior_of(model: ContactLagrangian, base: Baseline, departure: float | None) -> Prior:
    """The prior of every objective, sized by the data: rates are known to 0.3 of the slowest coordinate's own rate."""
    typical = min(v / s for v, s in zip(base.speed, base.scale, strict=True))
    return Prior(model, base.low, base.high, departure=departure, weight=1.0, rate_spread=0.3 * typical)


class _Departures(torch.nn.Module):
    """Force of the potential's network and rate of the damping's, as a module so that functional_call reaches them."""

    def __init__(self, model: ContactLagrangian):
        super().__init__()
        self.model = model

    def forward(self, q: Tensor, v: Tensor) -> tuple[Tensor | None, Tensor | None]:
        jet = self.model.potential.departure(coordinates(q, 1))
        force = None if jet is None else jet.gradient
        damping = self.model.damping
        rate = damping.departure(q, v) if isinstance(damping, AffineDamping) else None
        return force, rate
