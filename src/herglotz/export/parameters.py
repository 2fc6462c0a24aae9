"""Numbers of a model that an exported header takes at run time: which, their defaults and bounds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.models.numbers import chosen, values_of

Bounds = tuple[float | None, float | None]
# By name, or by name with bounds; None: no bound on that side.
Chosen = Sequence[str] | Mapping[str, Bounds | None]


def parsed(words: Sequence[str]) -> dict[str, Bounds]:
    """What `NAME` or `NAME=LOW:HIGH` of each word says; either bound may be left out.

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

    Raise InputError if the model has no such number, one is named twice, or its value lies outside its bounds.
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


def checked_values(entries: Mapping[str, Any], values: Mapping[str, float]) -> list[float]:
    """The numbers of these entries, with `values` in place of the defaults.

    Raise InputError if there is no such number, or a value is not finite or outside its bounds: what NAME_set_parameter
    refuses.
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
            raise InputError(f"{name} must be a finite number between {low} and {high}, got {value}")
        found.append(value)
    return found
