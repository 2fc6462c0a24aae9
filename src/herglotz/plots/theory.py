"""Figures of the theory: the identities of S^k of any L_d, and the paper's parachute."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from herglotz.data.files import PathLike
from herglotz.errors import InputError
from herglotz.plots import FIGURES
from herglotz.plots.hamilton_jacobi import plot_hamilton_jacobi_residual, plot_momentum_vs_generating_function
from herglotz.plots.parachute import physical_fall, plot_fall, plot_printed_map, printed_map
from herglotz.plots.style import save_all
from herglotz.verify.subject import named

# Figures of identities of S^k that hold to rounding. A model with forces has no S^k.
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
    return save_all(drawn, folder, form)
