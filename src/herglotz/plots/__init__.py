"""Figures of data, runs and the theory, as matplotlib `Figure` objects; no function opens a window."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.figure import Figure

from herglotz.data.files import PathLike, folder_at
from herglotz.errors import InputError
from herglotz.plots.animation import save_animation as save_animation
from herglotz.plots.bands import plot_bands as plot_bands
from herglotz.plots.hamilton_jacobi import (
    plot_hamilton_jacobi_residual as plot_hamilton_jacobi_residual,
    plot_momentum_vs_generating_function as plot_momentum_vs_generating_function,
)
from herglotz.plots.learned import plot_learned as plot_learned
from herglotz.plots.motion import plot_data as plot_data, plot_trajectory as plot_trajectory
from herglotz.plots.parachute import (
    physical_fall,
    plot_fall as plot_fall,
    plot_printed_map as plot_printed_map,
    printed_map,
)
from herglotz.plots.phase import plot_phase_portrait as plot_phase_portrait
from herglotz.plots.plan import plot_plan as plot_plan
from herglotz.plots.selection import plot_selection as plot_selection
from herglotz.plots.sizes import plot_sizes as plot_sizes
from herglotz.plots.style import save_figure as save_figure
from herglotz.plots.training import plot_training as plot_training
from herglotz.verify.subject import named

if TYPE_CHECKING:
    from herglotz.training import Run

FIGURES = {
    "trajectory": plot_trajectory,
    "phase_portrait": plot_phase_portrait,
    "learned": plot_learned,
    "training": plot_training,
    "plan": plot_plan,
    "sizes": plot_sizes,
}
# Of S^k, which a model with forces does not have: identities that hold to rounding.
IDENTITIES = {"momentum_vs_dS": plot_momentum_vs_generating_function, "hj_residual": plot_hamilton_jacobi_residual}
NAMED = {**FIGURES, **IDENTITIES}


def save_theory_figures(source: Any, folder: PathLike, *, h: float | None = None, form: str = "png") -> list[Path]:
    """Draw D2S^k = p_k and the discrete Hamilton–Jacobi equation of a source into `folder`, made if it is missing.

    Source: section 1 and errata E5 to E7 of `docs/mathematics.md`.

    Parameters
    ----------
    source
        Anything that `verify` takes and that has an L_d: a scene or its name, a run or its folder, an L_d with h, a
        pair (L_d, states) with h. The scene "parachute" adds the paper's two figures: the printed map, and a fall.
    folder
        Where the files go.
    h
        Step, in the source's unit of time; default that of the source.
    form
        png, svg or pdf.

    Returns
    -------
    list of Path
        What was written, one file a figure.

    Raises
    ------
    InputError
        If the source is none of these or has forces, whose map has no S^k; or the folder cannot be made.
    """
    source = named(source)
    L_d = getattr(source, "model", getattr(source, "L_d", source))
    if getattr(L_d, "friction", None) is not None or getattr(source, "external", None) is not None:
        raise InputError("with friction or other forces a step is no contact map: there is no S^k to draw")
    drawn = {name: plot(source, h=h) for name, plot in IDENTITIES.items()}
    if getattr(source, "name", "") == "parachute":
        drawn["parachute_map"] = plot_printed_map(printed_map()[1])
        drawn["parachute_fall"] = plot_fall(physical_fall()[1])
    return _saved(drawn, folder, form)


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
        In the order of `FIGURES`, without the plan, and the sizes of the models that a search compared, where the run
        holds none. All are drawn before one is written.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.
    """
    needed = {"plan": "plan", "sizes": "compared"}
    held = {name: plot for name, plot in FIGURES.items() if needed.get(name) is None or run.metrics.get(needed[name])}
    return _saved({name: plot(run) for name, plot in held.items()}, folder, form)


def _saved(drawn: dict[str, Figure], folder: PathLike, form: str) -> list[Path]:
    """Write figures by their names into `folder`, which is made if it is missing."""
    files = [folder_at(folder) / f"{name}.{form}" for name in drawn]
    for file, figure in zip(files, drawn.values(), strict=True):
        save_figure(figure, file)
    return files
