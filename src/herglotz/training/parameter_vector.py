"""A model as a function of one vector of its parameters, for Gauss–Newton."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.func import functional_call

from herglotz.mechanics import Partials
from herglotz.models import Capabilities, ContactLagrangian, numbers_of


class ParameterVector:
    """Partials of a model at any vector of parameters, without changing the model; usable inside vmap and jacrev.

    `numbers` are the names of the P numbers in the vector, `entries` the parameter and the index of each. Numbers that
    are `absent` by the model's configuration are 0 and no part of the vector. `free` names the numbers in the vector;
    the others keep their values in the model (None: all are in the vector).
    """

    def __init__(self, model: ContactLagrangian, free: Collection[str] | None = None):
        self.model = model
        named, every = dict(model.named_parameters()), numbers_of(model)
        self.names = list(named)
        self.shapes = [p.shape for p in named.values()]
        absent = set(model.config.absent)
        wanted = [name for name in every if name not in absent and (free is None or name in free)]
        self.numbers = wanted
        self.entries = [every[name] for name in self.numbers]
        self.learned = None if len(wanted) == len(every) else torch.tensor([name in wanted for name in every])  # (N,)
        # (N,) values of the numbers outside the vector; None: 0.
        self.held: Tensor | None = None
        if free is not None:
            still = torch.tensor([name not in absent for name in every])
            self.held = torch.where(still, nn.utils.parameters_to_vector(model.parameters()).detach().cpu(), 0.0)

    def get(self) -> Tensor:
        """The current parameters as one vector (P,)."""
        theta = nn.utils.parameters_to_vector(self.model.parameters()).detach().clone()
        return theta if self.learned is None else theta[self.learned.to(theta.device)]

    def set(self, theta: Tensor) -> None:
        """Write a vector back into the model."""
        nn.utils.vector_to_parameters(self._with_absent(theta.detach()), self.model.parameters())

    def unflatten(self, theta: Tensor) -> dict[str, Tensor]:
        """Named parameter tensors, absent numbers being 0."""
        parts = self._with_absent(theta).split([shape.numel() for shape in self.shapes])
        return {n: p.reshape(shape) for n, p, shape in zip(self.names, parts, self.shapes, strict=True)}

    def _with_absent(self, theta: Tensor) -> Tensor:
        """The numbers of all parameters, (N,)."""
        if self.learned is None:
            return theta
        at = self.learned.nonzero()[:, 0].to(theta.device)
        rest = theta.new_zeros(len(self.learned)) if self.held is None else self.held.to(theta)
        return rest.index_copy(0, at, theta)

    def partials(
        self, theta: Tensor, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int, u: Tensor | None = None
    ) -> Partials:
        """`herglotz.mechanics.partials` of the model with parameters theta, for steps with inputs u (..., m)."""
        return cast(Partials, functional_call(self.model, self.unflatten(theta), (q0, q1, s0, h, order, u)))

    def evaluated(
        self, theta: Tensor, function: Callable[..., Any], *args: Any, buffers: Mapping[str, Tensor] | None = None
    ) -> Any:
        """function(model, *args) of the model with parameters theta, and with other values of some `buffers`."""
        numbers = {f"model.{name}": x for name, x in (self.unflatten(theta) | dict(buffers or {})).items()}
        return functional_call(_FunctionOf(self.model, function), numbers, args)

    def at(self, theta: Tensor, u: Tensor | None = None) -> FixedModel:
        """The discrete Lagrangian with parameters theta, for steps with inputs u."""
        return FixedModel(self, theta, u)

    def index(self, prefix: str) -> Tensor:
        """Positions in the vector of all numbers with this prefix."""
        return torch.tensor([i for i, name in enumerate(self.numbers) if name.startswith(prefix)], dtype=torch.long)


class _FunctionOf(nn.Module):
    """A function of a `model` as a module, whose parameters and buffers `functional_call` reaches."""

    def __init__(self, model: ContactLagrangian, function: Callable[..., Any]):
        super().__init__()
        self.model, self.function = model, function

    def forward(self, *args: Any) -> Any:
        """Its value."""
        return self.function(self.model, *args)


class FixedModel:
    """A discrete Lagrangian with closed-form partials: the model at one parameter vector (and at inputs u).

    `buffers` of the model may have other values; these count in `partials_increment` alone.
    """

    def __init__(
        self, parameters: ParameterVector, theta: Tensor, u: Tensor | None = None,
        buffers: Mapping[str, Tensor] | None = None,
    ):  # fmt: skip
        self.parameters, self.theta, self.u, self.buffers = parameters, theta, u, buffers

    @property
    def capabilities(self) -> Capabilities:
        """The capabilities of the model."""
        return self.parameters.model.capabilities

    def at(self, u: Tensor) -> FixedModel:
        """The discrete Lagrangian of a step with inputs u, (..., m)."""
        return FixedModel(self.parameters, self.theta, u)

    def __call__(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor) -> Tensor:
        """L_d, shape (...)."""
        return self.partials(q0, q1, s0, h).L

    def partials(self, q0: Tensor, q1: Tensor, s0: Tensor, h: Tensor, order: int = 1) -> Partials:
        """See `herglotz.mechanics.partials`."""
        return self.parameters.partials(self.theta, q0, q1, s0, h, order, self.u)

    def partials_increment(self, q0: Tensor, delta: Tensor, s0: Tensor, h: Tensor, order: int) -> Partials:
        """See `ContactLagrangian.partials_increment`."""
        function, args = type(self.parameters.model).partials_increment, (q0, delta, s0, h, order, self.u)
        return self.parameters.evaluated(self.theta, function, *args, buffers=self.buffers)
