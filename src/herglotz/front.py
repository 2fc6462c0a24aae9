"""What a run can do by rooms that stand above `training`: pictures, exported files, verification."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from herglotz.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from herglotz.theory import Symmetries
    from herglotz.training import Run
    from herglotz.verify import Report


def plot(run: Run, name: str) -> Figure:
    """One of the figures of `herglotz.plots.FIGURES` or `IDENTITIES`, by name."""
    from herglotz.plots import FIGURES, IDENTITIES

    known = {**FIGURES, **IDENTITIES}
    if name not in known:
        raise InputError(f"there is no figure {name!r}; choose one of {', '.join(known)}")
    return known[name](run)


def export(run: Run, path: str | Path, kind: str | None, **settings: Any) -> Path:
    """Write one file that steps the model; see `herglotz.export.export_run`."""
    from herglotz.export import export_run

    return export_run(run, path, kind, **settings)


def verify(run: Run, **settings: Any) -> Report:
    """Measure every identity of the run; see `herglotz.verify.verify`."""
    from herglotz.verify import verify

    return verify(run, **settings)


def symmetries(run: Run, **settings: Any) -> Symmetries:
    """Find the symmetries of the run; see `herglotz.verify.symmetries`."""
    from herglotz.verify import symmetries

    return symmetries(run, **settings)


def report(run: Run, folder: str | Path, against: Any) -> list[Path]:
    """Write report.html and report.md; see `herglotz.report.write_report`."""
    from herglotz.data import as_trajectories
    from herglotz.report import write_report

    other = None if against is None else as_trajectories(against, like=run.data)
    return write_report(run, folder, other, name=str(folder))
