"""Figures of data, runs and the theory, as matplotlib `Figure` objects; no function opens a window."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from herglotz.data.files import PathLike
from herglotz.errors import InputError
from herglotz.plots.bands import plot_bands
from herglotz.plots.hamilton_jacobi import plot_hamilton_jacobi_residual, plot_momentum_vs_generating_function
from herglotz.plots.learned import plot_learned
from herglotz.plots.motion import plot_data, plot_trajectory
from herglotz.plots.parachute import plot_fall, plot_printed_map
from herglotz.plots.phase import plot_phase_portrait
from herglotz.plots.selection import plot_selection
from herglotz.plots.style import save_figure
from herglotz.plots.training import plot_training

if TYPE_CHECKING:
    from herglotz.training import Run

FIGURES = {
    "trajectory": plot_trajectory,
    "phase_portrait": plot_phase_portrait,
    "learned": plot_learned,
    "training": plot_training,
}
# Of S^k, which a model with forces does not have: identities that hold to rounding (`herglotz verify --plots`).
IDENTITIES = {
    "momentum_vs_dS": plot_momentum_vs_generating_function,
    "hj_residual": plot_hamilton_jacobi_residual,
}


def save_figures(
    run: Run, folder: PathLike, figures: Mapping[str, Callable[[Run], Figure]] = FIGURES, form: str = "png"
) -> list[Path]:
    """Draw the figures of a run and write them as png, svg or pdf into `folder`, which is made if it is missing.

    Returns
    -------
    list of Path
        In the order of `figures`. All figures are drawn before one is written.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    folder = Path(folder)
    drawn = {f"{name}.{form}": plot(run) for name, plot in figures.items()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another folder") from error
    for name, figure in drawn.items():
        save_figure(figure, folder / name)
    return [folder / name for name in drawn]


__all__ = [
    "FIGURES",
    "IDENTITIES",
    "plot_bands",
    "plot_data",
    "plot_fall",
    "plot_hamilton_jacobi_residual",
    "plot_learned",
    "plot_momentum_vs_generating_function",
    "plot_phase_portrait",
    "plot_printed_map",
    "plot_selection",
    "plot_training",
    "plot_trajectory",
    "save_figure",
    "save_figures",
]
