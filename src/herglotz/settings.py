"""Settings dataclasses to and from plain dictionaries, for JSON."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar

from herglotz.errors import InputError
from herglotz.schema import check_entries

T = TypeVar("T")


def from_plain(cls: type[T], values: dict[str, Any]) -> T:
    """Build a settings dataclass from what `dataclasses.asdict` and JSON made of it (tuples come back as lists).

    Raises
    ------
    InputError
        If a key is not one of its fields, or a value is not of its type.
    """
    unknown = set(values) - {f.name for f in fields(cls)}  # type: ignore[arg-type]
    if unknown:
        names = ", ".join(sorted(unknown))
        raise InputError(f"unknown setting {names} for {cls.__name__}; was it written by another version of herglotz?")
    check_entries(cls, values, f"the settings of {cls.__name__}", "take what herglotz wrote")
    plain: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return cls(**plain)
