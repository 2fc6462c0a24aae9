"""What a C header may hold beside its steps: files of `export/runtime`, and what in them depends on the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from herglotz.errors import InputError
from herglotz.export.c_numbers import number, numbers
from herglotz.export.metadata import EXTRAS

FILES = {"adjoint": ("adjoint",), "filter": ("filter", "smoother")}  # of `export/runtime`


def check_extras(extras: object, dof: int, most: int) -> None:
    """Refuse what there is not, and a filter of more coordinates than derivatives are written out for."""
    unknown = [x for x in extras if x not in EXTRAS] if isinstance(extras, list | tuple) else [extras]
    if unknown:
        raise InputError(f"extras may be {', '.join(EXTRAS)}, got {unknown[0]!r}; name them as a list")
    if "filter" in extras and dof > most:  # pyright: ignore[reportOperatorIssue]
        raise InputError(f"a filter in C needs the derivative of a step, up to {most} coordinates; this has {dof}")


def extras_source(entries: Mapping[str, Any], file: Callable[[str], str]) -> list[str]:
    """The texts of the extras that a header's metadata names; `file` reads one of the runtime."""
    found = []
    for name in entries.get("extras", ()):
        found += [file(f"{x}.h") for x in FILES[name]]
        if name == "filter" and (noise := entries.get("noise")):
            rows = [noise["position"], noise["momentum"]]
            rows += [noise["theta"]] if entries.get("parameters") else []
            values = ", ".join(f"{{{numbers(row, entries['dtype'])}}}" for row in rows)
            values += f", {number(noise['adaptation'], entries['dtype'])}"
            found.append(
                f"/* The noise that the fit found. */\nstatic const hz_noise hz_noise_of_fit = {{{values}}};\n"
            )
    return found
