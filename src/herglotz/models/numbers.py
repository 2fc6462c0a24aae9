"""A model as a function of some of its numbers, for derivatives by numbers and to set numbers between steps."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from herglotz.errors import InputError, refuse
from herglotz.models.model import ContactLagrangian, listed, numbers_of


class Line(NamedTuple):
    """A number λ that moves several numbers of a model along the line between two models.

    `value` is λ of the model, and `ends` has the values of every parameter at λ = 0 and at 1.
    """

    value: float
    ends: dict[str, tuple[Tensor, Tensor]]

    def at(self, amount: Tensor) -> dict[str, Tensor]:
        """The parameters at λ, ()."""
        return {name: _between(name, x0.to(amount), x1.to(amount), amount) for name, (x0, x1) in self.ends.items()}


def _between(name: str, x0: Tensor, x1: Tensor, amount: Tensor) -> Tensor:
    if not name.endswith("log_diagonal"):
        return x0 + amount * (x1 - x0)
    # Relative growth of the mass e^{2x} since λ = 0.
    growth = amount * torch.expm1(2 * (x1 - x0))
    return x0 + torch.atanh(growth / (growth + 2))


def lines(model: ContactLagrangian) -> Mapping[str, Line]:
    """The numbers of a model that move several numbers, by name."""
    return getattr(model, "lines", {})


def combined(model: ContactLagrangian, name: str, values: Mapping[str, float]) -> ContactLagrangian:
    """A copy of the model with a number λ called `name` that moves several numbers, from the model to `values` at 1.

    x(λ) = x + λ (x₁ − x), and for a mass e^{2x} of `log_diagonal` e^{2x(λ)} = e^{2x} + λ (e^{2x₁} − e^{2x}). A load
    that a body picks up adds to L in proportion to the load. The gauge, which fixes the first mass at 1, divides L by a
    number, and lines stay lines. The models of all loads therefore lie on the line between the models of two loads,
    unless a constant mass couples coordinates (`off_diagonal`); λ grows with the load, but not in proportion.

    Raise InputError if the name is no word or taken, nothing moves, a value is not finite, or the model lacks a number
    or already moves the number by another name. Weights of a network have no line between two networks.
    """
    known = numbers_of(model)
    chosen(model, list(values))
    words = {re.split(r"\W", x)[0] for x in (*known, *lines(model))}
    if not re.fullmatch(r"[A-Za-z]\w*", name) or name in words:
        raise InputError(f"'{name}' must be a word of letters, digits and _ that the model's numbers do not begin with")
    moved = {key: x for key, x in values.items() if values_of(model, [key]) != [x]}
    parameters = sorted({known[key][0] for key in moved})
    moved_already = {parameter for line in lines(model).values() for parameter in line.ends}
    fixed = [key for key in moved if known[key][0] in moved_already or ".network." in key]
    remedy = "give other values of numbers that are no weights of a network, each by one name"
    refuse({
        f"nothing differs for {name}; {remedy}": not moved,
        f"{fixed[0] if fixed else ''} cannot be moved by {name}; {remedy}": fixed,
    })  # fmt: skip
    end = with_values(model, moved)
    ends = {x: tuple(m.get_parameter(x).detach().clone() for m in (model, end)) for x in parameters}
    new: Any = copy.deepcopy(model)
    new.lines = {**lines(model), name: Line(0.0, ends)}  # pyright: ignore[reportArgumentType]
    return new


def chosen(model: ContactLagrangian, names: Sequence[str]) -> list[str]:
    """The model's numbers of these names: `friction.viscous[1]`, or `friction.viscous` for all its entries.

    Raise InputError if the model has no number of a name, or a number is named twice.
    """
    known, found = [*numbers_of(model), *lines(model)], []
    for name in names:
        own = [x for x in known if x == name or x.startswith((f"{name}[", f"{name}."))]
        if not own:
            raise InputError(f"parameters: the model has no number '{name}'; its numbers are {listed(known)}")
        found += own
    twice = sorted({name for name in found if found.count(name) > 1})
    if twice:
        raise InputError(f"parameters: {', '.join(twice)} is named twice; name each number once")
    return found


def values_of(model: ContactLagrangian, names: Sequence[str]) -> list[float]:
    """The present values of these numbers."""
    known, own = numbers_of(model), lines(model)
    return [
        own[name].value if name in own
        else float(model.get_parameter(known[name][0]).detach().reshape(-1)[known[name][1]])
        for name in names
    ]  # fmt: skip


class WithNumbers(nn.Module):
    """f(*arguments, θ), a function that reads a model, with the model's numbers θ (K,) as an argument.

    All samples share θ. Names that the model lacks are skipped. During the call the model's parameters are replaced.
    """

    def __init__(self, model: ContactLagrangian, function: Callable[..., Any], names: Sequence[str]):
        super().__init__()
        self.model, self.function = model, function
        known = numbers_of(model)
        places: dict[str, list[tuple[int, int]]] = {}
        for k, name in enumerate(names):
            if name in known:
                parameter, entry = known[name]
                places.setdefault(parameter, []).append((entry, k))
        self.places = {key: torch.tensor(rows).T for key, rows in places.items()}
        self.lines = [(k, lines(model)[name]) for k, name in enumerate(names) if name in lines(model)]

    def forward(self, *arguments: Any) -> Any:
        """Evaluate with the model's own parameters."""
        return self.function(*arguments)

    def at(self, *arguments: Any) -> Any:
        """f(*arguments, θ)."""
        *first, theta = arguments
        own_names, named = {name for name, _ in self.model.named_parameters()}, {}
        for k, line in self.lines:
            named |= {f"model.{name}": x for name, x in line.at(theta[k]).items() if name in own_names}
        for name, (entries, k) in self.places.items():
            own = named.get(f"model.{name}", self.model.get_parameter(name).detach())
            put = torch.index_put(own.reshape(-1), (entries,), theta[k])
            named[f"model.{name}"] = put.reshape(own.shape)
        return functional_call(self, named, tuple(first))


def with_values(model: ContactLagrangian, values: Mapping[str, float]) -> ContactLagrangian:
    """A copy of the model with these values of its numbers; lines are moved before single numbers.

    Raise InputError if the model has no number of a name, or a value is not finite.
    """
    known, own = numbers_of(model), lines(model)
    new: Any = copy.deepcopy(model)
    chosen(model, list(values))
    for name, value in sorted(values.items(), key=lambda x: x[0] not in own):
        if name not in known and name not in own:
            raise InputError(f"{name} stands for several numbers of the model; name each of them")
        if not math.isfinite(value):
            raise InputError(f"{name} must be a finite number, got {value}")
        if name in own:
            for key, x in own[name].at(torch.tensor(value, dtype=torch.float64)).items():
                new.get_parameter(key).data.copy_(x)
            new.lines = {**lines(new), name: own[name]._replace(value=value)}
            continue
        parameter, entry = known[name]
        new.get_parameter(parameter).data.view(-1)[entry] = value
    return new
