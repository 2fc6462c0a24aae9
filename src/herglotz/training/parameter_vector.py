"""A model seen as a function of one vector of its parameters, for Gauss–Newton."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn
from torch.func import functional_call

from herglotz.mechanics import Partials
from herglotz.models import Capabilities, ContactLagrangian


class ParameterVector:
    """Partials of a model at any vector of parameters, without touching the model; usable inside vmap and jacrev."""

    def __init__(self, model: ContactLagrangian):
        self.model = model
        named = dict(model.named_parameters())
        self.names = list(named)
        self.shapes = [p.shape for p in named.values()]
        self.sizes = [p.numel() for p in named.values()]

    def get(self) -> Tensor:
        """The current parameters as one vector (P,)."""
        return nn.utils.parameters_to_vector(self.model.parameters()).detach().clone()

    def set(self, theta: Tensor) -> None:
        """Write a vector back into the model."""
        nn.utils.vector_to_parameters(theta.detach(), self.model.parameters())

    def unflatten(self, theta: Tensor) -> dict[str, Tensor]:
        """Named parameter tensors."""
        parts = theta.split(self.sizes)
        return {n: p.reshape(shape) for n, p, shape in zip(self.names, parts, self.shapes, strict=True)}

    def partials(
        self, theta: Tensor, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int, u: Tensor | None = None
    ) -> Partials:
        """`herglotz.mechanics.partials` of the model with parameters theta, at the inputs u (..., m) of its steps."""
        return cast(Partials, functional_call(self.model, self.unflatten(theta), (q0, q1, s0, h, order, u)))

    def at(self, theta: Tensor, u: Tensor | None = None) -> FixedModel:
        """The discrete Lagrangian with parameters theta, of steps whose inputs are u."""
        return FixedModel(self, theta, u)

    def index(self, prefix: str) -> Tensor:
        """Positions in the vector of the parameters whose name starts with `prefix`."""
        ends = torch.tensor(self.sizes).cumsum(0).tolist()
        spans = zip(self.names, ends, self.sizes, strict=True)
        chosen = [torch.arange(end - size, end) for name, end, size in spans if name.startswith(prefix)]
        return torch.cat(chosen) if chosen else torch.zeros(0, dtype=torch.long)


class FixedModel:
    """A discrete Lagrangian with closed-form partials: the model at one parameter vector (and at inputs u)."""

    def __init__(self, parameters: ParameterVector, theta: Tensor, u: Tensor | None = None):
        self.parameters, self.theta, self.u = parameters, theta, u

    @property
    def capabilities(self) -> Capabilities:
        """The model's."""
        return self.parameters.model.capabilities

    def at(self, u: Tensor) -> FixedModel:
        """The discrete Lagrangian of a step whose inputs are u, (..., m)."""
        return FixedModel(self.parameters, self.theta, u)

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """L_d, shape (...)."""
        return self.partials(q0, q1, s0, h).L

    def partials(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int = 1) -> Partials:
        """See `herglotz.mechanics.partials`."""
        return self.parameters.partials(self.theta, q0, q1, s0, h, order, self.u)
