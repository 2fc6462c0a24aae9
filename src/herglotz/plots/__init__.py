"""Figures of data, runs and the theory, as matplotlib `Figure` objects. No function opens a window."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from herglotz.data.files import PathLike
from herglotz.models import own_name
from herglotz.plots.animation import save_animation as save_animation
from herglotz.plots.learned import plot_bands as plot_bands, plot_learned as plot_learned
from herglotz.plots.motion import plot_data as plot_data, plot_trajectory as plot_trajectory
from herglotz.plots.phase import plot_phase_portrait as plot_phase_portrait
from herglotz.plots.style import save_all, save_figure as save_figure
from herglotz.plots.training import (
    plot_plan as plot_plan,
    plot_selection as plot_selection,
    plot_sizes as plot_sizes,
    plot_training as plot_training,
)

if TYPE_CHECKING:
    from herglotz.plots.theory import (
        IDENTITIES as IDENTITIES,
        plot_fall as plot_fall,
        plot_hamilton_jacobi_residual as plot_hamilton_jacobi_residual,
        plot_momentum_vs_generating_function as plot_momentum_vs_generating_function,
        plot_printed_map as plot_printed_map,
        save_theory_figures as save_theory_figures,
    )
    from herglotz.training import Run

FIGURES = {
    "trajectory": plot_trajectory,
    "phase_portrait": plot_phase_portrait,
    "learned": plot_learned,
    "training": plot_training,
    "plan": plot_plan,
    "sizes": plot_sizes,
}
# These names are imported at first use: they import theory, scenes, export and verify, which no figure of a run needs.
_OF_THE_THEORY = (
    "IDENTITIES",
    "plot_fall",
    "plot_hamilton_jacobi_residual",
    "plot_momentum_vs_generating_function",
    "plot_printed_map",
    "save_theory_figures",
)


def __getattr__(name: str) -> Any:
    if name not in _OF_THE_THEORY:
        raise AttributeError(f"module 'herglotz.plots' has no attribute {name!r}")
    return getattr(import_module("herglotz.plots.theory"), name)


def save_figures(run: Run, folder: PathLike, form: str = "png") -> list[Path]:
    """Draw the figures of a run and write them into `folder`, which is made if it is missing.

    Parameters
    ----------
    run
        What `fit` returned.
    folder
        Where the files go.
    form
        png, svg or pdf.

    Returns
    -------
    list of Path
        The files, in the order of `FIGURES`. `plan` is left out for a run without a plan, `sizes` for a run without a
        search for terms, `learned` for an L_d of your own, and `training` for a run without a history, as where no
        stage of its fit found a path. Every figure is drawn before the first is written.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    required = {"plan": run.metrics.get("plan"), "sizes": run.metrics.get("compared"), "training": run.history,
                "learned": not own_name(run.model)}  # fmt: skip
    plots = {name: plot for name, plot in FIGURES.items() if required.get(name, True)}
    return save_all({name: plot(run) for name, plot in plots.items()}, folder, form)
