"""A model as a function of some of its numbers: for derivatives by them, and for what sets them between steps."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import nn
from torch.func import functional_call

from herglotz.errors import InputError
from herglotz.models.model import ContactLagrangian, numbers_of


def chosen(model: ContactLagrangian, names: Sequence[str]) -> list[str]:
    """The numbers of a model that names stand for: `friction.viscous[1]`, or `friction.viscous` for all of them.

    Raise InputError if a name is none, or one number is named twice.
    """
    every, found = list(numbers_of(model)), []
    for name in names:
        own = [x for x in every if x == name or x.startswith((f"{name}[", f"{name}."))]
        if not own:
            known = ", ".join(x for x in every if ".network." not in x)  # weights are hundreds
            raise InputError(f"parameters: the model has no number '{name}'; its numbers are {known}")
        found += own
    twice = sorted({name for name in found if found.count(name) > 1})
    if twice:
        raise InputError(f"parameters: {', '.join(twice)} is named twice; name each number once")
    return found


def values_of(model: ContactLagrangian, names: Sequence[str]) -> list[float]:
    """The present values of these numbers."""
    every = numbers_of(model)
    return [float(model.get_parameter(every[name][0]).detach().reshape(-1)[every[name][1]]) for name in names]


class WithNumbers(nn.Module):
    """A function of a model as a function of some of the model's numbers too: f(*arguments, θ) with θ (K,).

    θ has no batch: all samples share it. Numbers that the model has not are passed over; `function` reads the model
    itself, whose parameters are replaced during the call.
    """

    def __init__(self, model: ContactLagrangian, function: Callable[..., Any], names: Sequence[str]):
        super().__init__()
        self.model, self.function = model, function
        every = numbers_of(model)
        places: dict[str, list[tuple[int, int]]] = {}
        for k, name in enumerate(names):
            if name in every:
                parameter, entry = every[name]
                places.setdefault(parameter, []).append((entry, k))
        self.places = {key: torch.tensor(rows).T for key, rows in places.items()}

    def forward(self, *arguments: Any) -> Any:
        """Evaluate with the model's own parameters."""
        return self.function(*arguments)

    def at(self, *arguments: Any) -> Any:
        """f(*arguments, θ)."""
        *first, theta = arguments
        named = {}
        for name, (entries, k) in self.places.items():
            own = self.model.get_parameter(name).detach()
            put = torch.index_put(own.reshape(-1), (entries,), theta[k])
            named[f"model.{name}"] = put.reshape(own.shape)
        return functional_call(self, named, tuple(first))


def with_values(model: ContactLagrangian, values: Mapping[str, float]) -> ContactLagrangian:
    """A copy of the model with other values of these numbers.

    Raise InputError if the model has no number of a name, or a value is not finite.
    """
    new, every = copy.deepcopy(model), numbers_of(model)
    chosen(model, list(values))
    for name, value in values.items():
        if name not in every:
            raise InputError(f"{name} stands for several numbers of the model; name each of them")
        if not math.isfinite(value):
            raise InputError(f"{name} must be a finite number, got {value}")
        parameter, entry = every[name]
        new.get_parameter(parameter).data.view(-1)[entry] = value
    return new
