"""Check stored entries against type hints: a wrong file raises one `InputError`."""

from __future__ import annotations

import types
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints, is_typeddict

from herglotz.errors import InputError

T = TypeVar("T")
UNION = (Union, types.UnionType)
# torch's integers have 64 bits. JSON has no bound, and an integer of 10^400 is no float either.
MAX_INTEGER = 2**63 - 1


def check_entries(kind: Any, values: Any, where: str, remedy: str) -> None:
    """Check a dictionary against the hints of a `TypedDict` or a dataclass; other keys are ignored.

    Hints may be bool, int, float (which takes an int), str, classes, None, unions, Literal, another `TypedDict`, and
    list[T], tuple[T, ...], tuple[T, T, T], dict[K, V] of these. Lists and tuples are equal, as in JSON. Fields of a
    dataclass with a default may be missing. InputError names the file, the key, its value and the remedy.
    """
    if not isinstance(values, Mapping):
        raise InputError(f"{where}: must hold named entries, got {_shown(values)}; {remedy}")
    missing = [key for key in _needed(kind) if key not in values]
    if missing:
        raise InputError(f"{where}: lacks {', '.join(sorted(missing))}; {remedy}")
    for key, hint in get_type_hints(kind).items():
        if key not in values or (values[key] is None and types.NoneType in get_args(hint)):
            continue
        alternatives = get_args(hint) if get_origin(hint) in UNION else (hint,)
        # A nested dictionary is checked key by key, so that the message names the key.
        if nested := [kind for kind in alternatives if is_typeddict(kind) or is_dataclass(kind)]:
            check_entries(nested[0], values[key], f"{where}: {key}", remedy)
        elif not matches(values[key], hint):
            raise InputError(f"{where}: {key} must be {_named(hint)}, got {_shown(values[key])}; {remedy}")


def from_plain(cls: type[T], values: dict[str, Any]) -> T:
    """Build a settings dataclass from the dictionary that `dataclasses.asdict` and JSON made; lists become tuples.

    Raise InputError if a key is no field, or a value has another type than its field.
    """
    unknown = set(values) - {f.name for f in fields(cls)}  # type: ignore[arg-type]
    if unknown:
        names = ", ".join(sorted(unknown))
        raise InputError(f"unknown setting {names} for {cls.__name__}; was it written by another version of herglotz?")
    check_entries(cls, values, f"the settings of {cls.__name__}", "take what herglotz wrote")
    plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return cls(**plain)


def matches(value: Any, hint: Any) -> bool:
    """True if a value, with all its entries, matches a type hint."""
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


def _needed(kind: Any) -> Collection[str]:
    """The required keys: all keys of a `TypedDict`, the fields of a dataclass that have no default."""
    if is_typeddict(kind):
        return kind.__required_keys__
    return [f.name for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]


def _match_items(values: dict[Any, Any], hint: Any, inner: tuple[Any, ...]) -> bool:
    """True if a dictionary matches a dataclass, or dict[K, V]."""
    if inner:
        return all(matches(key, inner[0]) and matches(x, inner[1]) for key, x in values.items())
    hints = get_type_hints(hint)
    return all(key in values for key in _needed(hint)) and all(
        matches(x, hints.get(key, Any)) for key, x in values.items()
    )


def _match_each(values: Sequence[Any], hints: tuple[Any, ...]) -> bool:
    """True if entries match list[T] or tuple[T, ...], or one by one tuple[S, T]."""
    if len(hints) == 1 or hints[1] is Ellipsis:
        return all(matches(x, hints[0]) for x in values)
    return len(values) == len(hints) and all(map(matches, values, hints))


def _is_number(value: Any, hint: type) -> bool:
    """True if a value is a number of this type that torch takes; a bool is no number."""
    if isinstance(value, int):
        return not isinstance(value, bool) and abs(value) <= MAX_INTEGER
    return isinstance(value, hint)


def _named(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint).replace("typing.", "")


def _shown(value: Any) -> str:
    text = " ".join(repr(value).split())
    return f"{text[:60]}{'…' if len(text) > 60 else ''} ({type(value).__name__})"
