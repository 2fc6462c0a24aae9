"""Further functions of a C header: files of `export/runtime`, and their constants that depend on the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from herglotz.errors import InputError
from herglotz.export.c_numbers import number, numbers
from herglotz.export.metadata import EXTRAS

# The files of `export/runtime` of each extra.
FILES = {"adjoint": ("adjoint",), "filter": ("filter", "smoother")}


def check_extras(extras: object, dof: int, most: int) -> None:
    """Refuse unknown extras, and a filter of more than `most` coordinates, which have no derivative in C."""
    unknown = [x for x in extras if x not in EXTRAS] if isinstance(extras, list | tuple) else [extras]
    if unknown:
        raise InputError(f"extras may be {', '.join(EXTRAS)}, got {unknown[0]!r}; name them as a list")
    if "filter" in extras and dof > most:  # pyright: ignore[reportOperatorIssue]
        raise InputError(f"a filter in C needs the derivative of a step, up to {most} coordinates; this has {dof}")


def extras_source(entries: Mapping[str, Any], file: Callable[[str], str]) -> list[str]:
    """The texts of the extras that a header's metadata names; `file` reads a file of the runtime."""
    found = []
    for name in entries.get("extras", ()):
        found += [file(f"{x}.h") for x in FILES[name]]
        if name == "filter" and (noise := entries.get("noise")):
            rows = [noise["position"], noise["momentum"]]
            rows += [noise["theta"]] if entries.get("parameters") else []
            values = ", ".join(f"{{{numbers(row, entries['dtype'])}}}" for row in rows)
            values += f", {number(noise['adaptation'], entries['dtype'])}"
            found += [f"/* The noise of the fit. */\nstatic const hz_noise hz_noise_of_fit = {{{values}}};\n"]
    return found
