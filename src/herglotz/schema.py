"""Types of stored entries, as plain type hints: reading a wrong file raises an error with a single message."""

from __future__ import annotations

import types
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints, is_typeddict

from herglotz.errors import InputError

T = TypeVar("T")
UNION = (Union, types.UnionType)
# Largest whole number that torch takes; JSON has no bound, and 10^400 is no float either.
LARGEST = 2**63 - 1


def check_entries(kind: Any, values: Any, where: str, remedy: str) -> None:
    """Check a dictionary against the hints of a `TypedDict` or a dataclass; further keys are let pass.

    `kind` has keys and their types: bool, int, float (an int will do), str, classes, None, unions, Literal, another
    `TypedDict`, and list[T], tuple[T, ...], tuple[T, T, T], dict[K, V] of these. A list and a tuple are one, as in
    JSON. Keys of a dataclass that have a default may be missing. InputError names the file, the key, its value and the
    remedy.
    """
    if not isinstance(values, Mapping):
        raise InputError(f"{where}: must hold named entries, got {_shown(values)}; {remedy}")
    missing = [key for key in _needed(kind) if key not in values]
    if missing:
        raise InputError(f"{where}: lacks {', '.join(sorted(missing))}; {remedy}")
    for key, hint in get_type_hints(kind).items():
        if key not in values or (values[key] is None and types.NoneType in get_args(hint)):
            continue
        alone = [one for one in _alternatives(hint) if is_typeddict(one) or is_dataclass(one)]
        if alone:  # looked into key by key, so that the message names one
            check_entries(alone[0], values[key], f"{where}: {key}", remedy)
        elif not matches(values[key], hint):
            raise InputError(f"{where}: {key} must be {_named(hint)}, got {_shown(values[key])}; {remedy}")


def from_plain(cls: type[T], values: dict[str, Any]) -> T:
    """Build a settings dataclass from what `dataclasses.asdict` and JSON made of it (tuples come back as lists).

    Raise InputError if a key is no field, or a value has another type than the field.
    """
    unknown = set(values) - {f.name for f in fields(cls)}  # type: ignore[arg-type]
    if unknown:
        names = ", ".join(sorted(unknown))
        raise InputError(f"unknown setting {names} for {cls.__name__}; was it written by another version of herglotz?")
    check_entries(cls, values, f"the settings of {cls.__name__}", "take what herglotz wrote")
    plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return cls(**plain)


def matches(value: Any, hint: Any) -> bool:
    """Whether a value is of a type, to its last entry."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if origin in UNION:
        return any(matches(value, one) for one in inner)
    if origin is Literal:
        return value in inner
    if origin in (list, tuple):
        return isinstance(value, (list, tuple)) and _match_each(value, inner)
    if is_dataclass(hint) or origin is dict:
        return isinstance(value, dict) and _match_items(value, hint, inner)
    return _is_number(value, hint) if hint in (int, float) else isinstance(value, hint)


def _alternatives(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in UNION else (hint,)


def _needed(kind: Any) -> Collection[str]:
    """The required keys: all keys of a `TypedDict`, the fields of a dataclass that have no default."""
    if is_typeddict(kind):
        return kind.__required_keys__
    return [f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]


def _match_items(values: dict[Any, Any], hint: Any, inner: tuple[Any, ...]) -> bool:
    """Whether entries are those of a dataclass, or of dict[K, V]."""
    if inner:
        return all(matches(key, inner[0]) and matches(x, inner[1]) for key, x in values.items())
    hints = get_type_hints(hint)
    return all(key in values for key in _needed(hint)) and all(
        matches(x, hints.get(key, Any)) for key, x in values.items()
    )


def _match_each(values: Sequence[Any], hints: tuple[Any, ...]) -> bool:
    """Whether entries are of list[T] or tuple[T, ...], or, one by one, of tuple[S, T]."""
    if len(hints) == 1 or hints[1] is Ellipsis:
        return all(matches(x, hints[0]) for x in values)
    return len(values) == len(hints) and all(map(matches, values, hints))


def _is_number(value: Any, hint: type) -> bool:
    """Whether a value is a number of this type that torch takes; a truth value is no number."""
    if isinstance(value, int):
        return not isinstance(value, bool) and abs(value) <= LARGEST
    return isinstance(value, hint)


def _named(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint).replace("typing.", "")


def _shown(value: Any) -> str:
    text = " ".join(repr(value).split())
    return f"{text[:60]}{'…' if len(text) > 60 else ''} ({type(value).__name__})"
