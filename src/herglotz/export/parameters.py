"""Numbers of a model that an exported header takes at run time: their names, defaults and bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian, numbers_of
from herglotz.models.numbers import chosen, combined, lines, values_of, with_values
from herglotz.training import Run

Bounds = tuple[float | None, float | None]
# Names, or names with bounds; None: no bound on that side.
Chosen = Sequence[str] | Mapping[str, Bounds | None]


def parsed(words: Sequence[str]) -> dict[str, Bounds]:
    """Names with bounds from words such as `NAME` or `NAME=LOW:HIGH`; either bound may be left out.

    Raise InputError if a bound is no number, or a name is given twice.
    """
    found: dict[str, Bounds] = {}
    for word in words:
        name, _, span = word.partition("=")
        low, _, high = span.partition(":")
        if name in found:
            raise InputError(f"parameters: {name} is given twice; name each number once")
        try:
            found[name] = (float(low) if low else None, float(high) if high else None)
        except ValueError:
            raise InputError(f"parameters: bounds are numbers, as in {name}=0:2, got '{word}'") from None
    return found


def described_parameters(model: ContactLagrangian, parameters: Chosen) -> dict[str, list[float | None]]:
    """Entries of a file's metadata: the value (the default), low and high of each number, None without a bound.

    Raise InputError if the model has no such number, a name is given twice, or a value lies outside its bounds.
    """
    if isinstance(parameters, str):
        raise InputError(f"parameters takes a list of names, got the text '{parameters}'; write ['{parameters}']")
    bounds = dict(parameters) if isinstance(parameters, Mapping) else dict.fromkeys(parameters)
    if not isinstance(parameters, Mapping) and len(bounds) < len(parameters):
        raise InputError(f"parameters: a name is given twice in {', '.join(parameters)}; name each number once")
    chosen(model, list(bounds))
    found: dict[str, list[float | None]] = {}
    for given, own in bounds.items():
        low, high = own or (None, None)
        for name in chosen(model, [given]):
            (value,) = values_of(model, [name])
            if not (-math.inf if low is None else low) <= value <= (math.inf if high is None else high):
                raise InputError(
                    f"parameters: {name} is {value:g}, outside its bounds {low} and {high}; widen them around it"
                )
            found[name] = [value, low, high]
    return found


def between(run: Run, name: str, other: Run) -> Run:
    """The run with a number `name` that moves all numbers of its model: at 0 to this run's, at 1 to the other's.

    Example: fits of the same terms without a payload and with one. Smaller and larger payloads lie on the line through
    both (`herglotz.models.numbers.combined`). `parameters` of `export` and of `hz.filter` take the name.

    Raise InputError if the models have different numbers, differ in a network's weights, or do not differ at all.
    """
    own, theirs = numbers_of(run.model), numbers_of(other.model)
    if odd := sorted(set(own) ^ set(theirs)):
        raise InputError(
            f"{name}: {odd[0]} is a number of one of the runs alone; fit one with the plan "
            "of the other: hz.fit(data, plan=run), herglotz fit DATA --plan RUN"
        )
    values = dict(zip(theirs, values_of(other.model, list(theirs)), strict=True))
    return replace(run, model=combined(run.model, name, values))


def moved_numbers(model: ContactLagrangian, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The metadata entry `between`: parameters that move several numbers, with the values of these numbers at 1."""
    found = {}
    for name, line in lines(model).items():
        if name not in parameters:
            continue
        if line.value:
            raise InputError(f"{name} is {line.value:g} in the model; export the model at 0")
        names = [x for x, (parameter, _) in numbers_of(model).items() if parameter in line.ends]
        found[name] = dict(zip(names, values_of(with_values(model, {name: 1.0}), names), strict=True))
    return {"between": found} if found else {}


def with_moved_numbers(model: ContactLagrangian, entries: Mapping[str, Any]) -> ContactLagrangian:
    """The model with the entry `between` of a file's metadata, where the model does not have it already."""
    for name, values in entries.get("between", {}).items():
        model = model if name in lines(model) else combined(model, name, values)
    return model


def checked_values(entries: Mapping[str, Any], values: Mapping[str, float]) -> list[float]:
    """The values of all numbers in these entries, with `values` in place of the defaults.

    Raise InputError if no entry has such a name, or a value is not finite or outside its bounds, as NAME_set_parameter
    of the header does.
    """
    unknown = sorted(set(values) - set(entries))
    if unknown:
        known = ", ".join(entries) or "none"
        raise InputError(f"no number '{unknown[0]}' is set at run time; those that are: {known}; export it with it")
    found = []
    for name, (default, low, high) in entries.items():
        value = float(values.get(name, default))
        inside = (low is None or value >= low) and (high is None or value <= high)
        if not (math.isfinite(value) and inside):
            ends = [f" {word} {x:g}" for word, x in ((">=", low), ("<=", high)) if x is not None]
            raise InputError(f"{name} must be a finite number{' and'.join(ends)}, got {value}")
        found.append(value)
    return found
