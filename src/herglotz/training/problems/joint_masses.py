"""The masses that momenta at the joints of segments are divided by, and their derivatives by the parameters."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn
from torch.func import functional_call

from herglotz.models.terms import FeatureKinetic, Kinetic, PositionKinetic
from herglotz.training.parameter_vector import ParameterVector

# Samples over which a mass is averaged.
FEW = 8


class JointMasses:
    """The diagonal of the mass matrix over a few of the positions q, (N, n)."""

    def __init__(self, parameters: ParameterVector, q: Tensor):
        self.parameters = parameters
        self.q = q[torch.linspace(0, len(q) - 1, FEW, device=q.device).round().long()]
        self._made: tuple[Tensor, Tensor] | None = None

    @property
    def move(self) -> bool:
        """Whether the masses depend on the parameters; the mass of the first coordinate is 1."""
        return self.q.shape[1] > 1 and self.parameters.model.config.baseline

    def at(self, theta: Tensor) -> Tensor:
        """At θ, (n,), positive."""
        return self._graph(theta)[1].detach()

    def slopes(self, theta: Tensor) -> Tensor:
        """∂ log mass / ∂θ, (n, P)."""
        own, mass = self._graph(theta)
        if not mass.requires_grad:
            return theta.new_zeros(len(mass), len(theta))
        rows = (torch.autograd.grad(x, own, retain_graph=True)[0] for x in mass)
        return torch.stack(list(rows)) / mass.detach()[:, None]

    def _graph(self, theta: Tensor) -> tuple[Tensor, Tensor]:
        """θ and the masses, as autograd remembers them; made once for a θ, which a fit asks for again."""
        if self._made is None or not torch.equal(self._made[0], theta):
            with torch.enable_grad():
                theta = theta.detach().clone().requires_grad_()
                named = self.parameters.unflatten(theta)
                own = {name: value for name, value in named.items() if name.startswith("kinetic.")}
                mass = functional_call(_Mass(self.parameters.model.kinetic), own, (self.q,))
                mass = mass.diagonal(0, -2, -1).abs().mean(0).clamp_min(torch.finfo(theta.dtype).tiny ** 0.5)
            self._made = theta, mass
        return self._made


class _Mass(nn.Module):
    """The mass matrix of a kinetic term as a module whose parameters can be given."""

    def __init__(self, kinetic: nn.Module):
        super().__init__()
        self.kinetic = kinetic

    def forward(self, q: Tensor) -> Tensor:
        """(k, n, n) at positions (k, n)."""
        of = self.kinetic
        if not isinstance(of, FeatureKinetic):
            return of.mass(q) if isinstance(of, PositionKinetic) else cast(Kinetic, of).mass().expand(len(q), -1, -1)
        return _Mass(of.base)(q) + of.mass(q)
