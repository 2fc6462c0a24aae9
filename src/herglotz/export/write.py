"""Writing a model as a file of one format: what the formats share."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from herglotz.data.files import PathLike, write_atomically
from herglotz.export.metadata import describe
from herglotz.export.newton import ITERATIONS
from herglotz.export.trusted import remember
from herglotz.models import ContactLagrangian


def writes(content: Callable[[ContactLagrangian, dict[str, Any]], bytes]):
    """Make of a function (model, metadata) → content of a file, sealed, the function that writes the file."""

    def export(
        model: ContactLagrangian,
        path: PathLike,
        *,
        h: float,
        box: Mapping[str, Sequence[float]] | None = None,
        units: Sequence[str] = (),
        metadata: Mapping[str, Any] | None = None,
        newton_iterations: int = ITERATIONS,
    ) -> Path:
        made = content(model, describe(model, h, box, units, newton_iterations, metadata or {}))
        write_atomically(path, made)
        remember(made)
        return Path(path)

    for name in ("__module__", "__name__", "__qualname__", "__doc__"):
        setattr(export, name, getattr(content, name))
    return export
