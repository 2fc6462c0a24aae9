"""The prior of a model: Gaussian, around the baseline."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from herglotz.errors import refuse
from herglotz.models import ContactLagrangian
from herglotz.models.jet import coordinates
from herglotz.models.terms import AffineDamping
from herglotz.training.baseline import Baseline
from herglotz.training.dictionary import keys_of
from herglotz.training.parameter_vector import ParameterVector

# Parameters of networks, of order one, by the start of their names.
NETWORKS = ("potential.network", "damping.network", "correction", "kinetic.network", "action.log_slope",
            "action.weight", "action.bias")  # fmt: skip
# Deviation of the logarithms of dry friction's widths. Widths below the resolution of a step only make it stiff.
WIDTH = 0.5
# Deviation of viscous friction of a single coordinate, over that of the rate. Both act alike, and a large rate that a
# negative friction cancels would forbid long steps.
SPLIT = 1e-3
# Points of the grid, per coordinate and in all. More do not change an RMS, and each has n rows.
EACH, MAX_POINTS = 64, 256
# Deviation of Stribeck's excess force, over the baseline's force. A broad excess would replace viscous friction.
BREAKAWAY = 0.01


class Gaussian:
    """The prior of independent numbers: N(start, spread²), with weight = 1 / spread², 0 without a prior."""

    def __init__(self, start: Tensor, weight: Tensor):
        self.start, self.weight = start, weight  # (P,), (P,)

    def cost(self, theta: Tensor) -> Tensor:
        """½ Σ ((θ − start) / spread)²."""
        return ((theta - self.start).square() * self.weight).sum() / 2

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(cost, JᵀJ, Jᵀr)."""
        return self.cost(theta), self.weight.diag(), self.weight * (theta - self.start)


class Prior:
    """Gaussian prior, as residuals of a least-squares problem. `low` and `high` are the range of q in the data.

    * The force of the potential's network, −∂V_net/∂q, has over the range of the data an RMS of N(0, (τ F)²), with F
      the RMS force of the baseline: `departure` = τ. (The grid points share the weight of one residual.)
    * The damping's network G(q̄, v) (affine level) has there an RMS of N(0, (τ r)²), r the typical rate of the motion.
    * Every network weight is N(its start, `weight`²), a weak prior against drift of undetermined weights. (Centred at 0
      it would switch the network off: with a last layer that starts at 0, only the prior acts on the first layer.)
    * The damping rate, the drag coefficients (per unit of position) and the rates of the full level's units are
      N(their start, `rate_spread`²), and with `wide_rates` at least N(start, start²): the damping rate of a body that
      falls is many times the rate of its fall. Viscous friction is N(start, (`rate_spread` m)²) and dry friction
      N(0, (`rate_spread` m speed)²), with the mass m that makes the kinetic energy that of the first coordinate, whose
      mass is 1: the mass of an angle beside a length in mm is in mm². The excess of dry friction at breakaway is
      N(0, (0.01 F)²), and the logarithms of its widths are N(their start, 0.5²).
    * A `herglotz.models.Term` has its own spread, and the waves of functions have `spreads`, around 0.
    """

    def __init__(
        self,
        model: ContactLagrangian,
        low: Tensor,  # (n,)
        high: Tensor,  # (n,)
        *,
        departure: float | None,
        weight: float = 10.0,
        rate_spread: float = 1.0,
        wide_rates: bool = True,
        spreads: Mapping[str, float] | None = None,
    ):
        self.parameters = ParameterVector(model)
        self.start, self.departure = self.parameters.get(), departure
        keys, spreads = keys_of(self.parameters.numbers, model.config), spreads or {}
        refuse({
            f"the prior deviation of '{key}' is {spread:g}, but must be a number > 0": not 0 < spread < math.inf
            for key, spread in spreads.items()
        })  # fmt: skip
        self.waves = {i: spreads[key] for i, key in enumerate(keys) if key in spreads}
        self.start[list(self.waves)] = 0.0
        points = torch.quasirandom.SobolEngine(2 * len(low), seed=0, scramble=True)
        unit = points.draw(min(EACH * len(low), MAX_POINTS)).to(low)
        speed = low.new_tensor(model.config.speed)
        self.grid = unit[:, : len(low)] * (high - low) + low
        self.velocity = (2 * unit[:, len(low) :] - 1) * speed
        self.typical_rate = float((speed / low.new_tensor(model.config.scale)).min())
        with torch.no_grad():
            own, features = model.potential.baseline(self.grid, 1).gradient, model.potential.features
            if features is not None and not bool(own.any()):
                own = features(self.grid, 1).gradient
        # RMS force of the baseline.
        self.force = float(own.square().mean().sqrt()) or 1.0
        self.index, self.spread = self._own(model, weight, rate_spread)
        if wide_rates:
            rates = torch.isin(self.index, self._index("damping.rate", "damping.drag", "action.rate").to(self.index))
            self.spread = self.spread.maximum(torch.where(rates, self.start[self.index].abs(), 0.0))
        self.networks = self._index(*NETWORKS).to(self.start.device)
        with torch.no_grad():
            self.departs = departure is not None and bool(self._departures(self.start, self.grid, self.velocity))

    def residuals(self, theta: Tensor) -> Tensor:
        """Prior residuals, (m,)."""
        own = (theta - self.start)[self.index] / self.spread
        return torch.cat([own, self._departed(theta, self.grid, self.velocity).reshape(-1)]) if self.departs else own

    def cost(self, theta: Tensor) -> Tensor:
        """½|residuals|²."""
        return self.residuals(theta).square().sum() / 2

    def normal_equations(self, theta: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(½|r|², JᵀJ, Jᵀr) of the prior alone."""
        own = (theta - self.start)[self.index] / self.spread
        cost, b = own.square().sum() / 2, torch.zeros_like(theta).index_add(0, self.index, own / self.spread)
        A = torch.zeros_like(theta).index_add(0, self.index, self.spread**-2).diag()
        if self.departs:
            # The derivative is taken point by point: that of all points at once took 44 GB for twenty coordinates.
            def departed(x: Tensor, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
                r = self._departed(theta.index_copy(0, self.networks, x), q, v)
                return r, r

            slopes = vmap(jacrev(departed, has_aux=True), (None, 0, 0), out_dims=1)
            J, r = (x.flatten(0, 1) for x in slopes(theta[self.networks], self.grid, self.velocity))
            A[self.networks[:, None], self.networks] += J.T @ J
            cost, b = cost + r.square().sum() / 2, b.index_add(0, self.networks, J.T @ r)
        return cost, A, b

    def _own(self, model: ContactLagrangian, weight: float, rate_spread: float) -> tuple[Tensor, Tensor]:
        """Places and spreads of the parameters with an own prior N(start, spread²), (m,) each."""
        speed = self.start.new_tensor(model.config.speed)
        mass = (speed[0] / speed).square()
        viscous, coulomb = self._index("friction.viscous"), self._index("friction.coulomb")
        spreads = [
            (self._index(*NETWORKS), weight),
            (self._index("damping.rate", "damping.drag", "action.rate"), rate_spread),
            (viscous, rate_spread * (SPLIT if len(speed) == 1 else mass[self._coordinates(viscous)])),
            (coulomb, rate_spread * (mass * speed)[self._coordinates(coulomb)]),
            (self._index("friction.breakaway"), BREAKAWAY * self.force),
            (self._index("friction.log"), WIDTH),
            *(
                (self._index(f"more.{i}."), term.spread)
                for i, term in enumerate(model.named_terms)
                if term.spread is not None
            ),
            *((torch.tensor([i]), spread) for i, spread in self.waves.items()),
        ]
        index = torch.cat([index for index, _ in spreads]).to(self.start.device)
        return index, torch.cat([spread * torch.ones_like(self.start[index]) for index, spread in spreads])

    def _coordinates(self, index: Tensor) -> list[int]:
        """The coordinates, counted from 0, of numbers of which each coordinate has one."""
        names = [self.parameters.numbers[i] for i in index.tolist()]
        return [int(name.partition("[")[2].rstrip("]") or 0) for name in names]

    def _index(self, *prefixes: str) -> Tensor:
        return torch.cat([self.parameters.index(prefix) for prefix in prefixes])

    def _departed(self, theta: Tensor, q: Tensor, v: Tensor) -> Tensor:
        """The residuals of the networks' outputs at points of the grid, (k, ...)."""
        parts = self._departures(theta, q, v)
        return torch.cat([x / (self.departure * (len(self.grid) * len(x)) ** 0.5) for x in parts])

    def _departures(self, theta: Tensor, q: Tensor, v: Tensor) -> list[Tensor]:
        """Network outputs, each relative to its natural size: forces (n, ...) and rates (1, ...)."""
        force, rate = self.parameters.evaluated(theta, _departures, q, v)
        parts = [] if force is None else [force / self.force]
        return parts if rate is None else [*parts, rate[None] / self.typical_rate]


def prior_of(model: ContactLagrangian, base: Baseline, departure: float | None, wide_rates: bool = True) -> Any:
    """The `Prior` of every objective; the deviation of rates is 0.3 of the rate |q̇|/|q| of the slowest coordinate.

    With `wide_rates` that of a rate which starts larger is as large as the rate. None for the user's own
    L_d, whose parameters have no known meaning.
    """
    if not isinstance(model, ContactLagrangian):
        return None
    typical = min(v / s for v, s in zip(base.speed, base.scale, strict=True))
    return Prior(
        model, base.low, base.high, departure=departure, weight=1.0, rate_spread=0.3 * typical,
        wide_rates=wide_rates, spreads=base.spreads,
    )  # fmt: skip


def _departures(model: ContactLagrangian, q: Tensor, v: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Force of the potential's network, and rate of the damping's."""
    jet, damping = model.potential.departure(coordinates(q, 1)), model.damping
    rate = damping.departure(q, v) if isinstance(damping, AffineDamping) else None
    return None if jet is None else jet.gradient, rate
