"""The learned functions of a model: potential, force, friction, damping and mass along each coordinate."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from herglotz.plots.motion import momentum_unit
from herglotz.plots.style import MODEL, MUTED, SERIES, SUPPORT, captions, new_figure, position_axis, styled, with_unit
from herglotz.training.learned_functions import LearnedFunction, learned_functions

if TYPE_CHECKING:
    from herglotz.training import Laplace, Run

MAX_COLUMNS, POINTS = 3, 161
# Functions are drawn beyond the data, on both sides by this part of the data's range.
BEYOND = 0.25
ROWS = ("potential", "force", "friction", "damping", "mass")


def plot_learned(run: Run, posterior: Laplace | None = None) -> Figure:
    """Draw the functions that a run has learned, along each coordinate with the others at their median.

    The functions are V(q_i), the force −∂V/∂q_i, friction over the velocity, and, if they depend on position, damping
    and the entries m_jk of the mass (`herglotz.training.learned_functions`). The mean of the first mass over the data
    is 1, so that forces are accelerations of the first coordinate. The range of the data is shaded: the mean of V over
    this range is 0, and beyond the range the model extrapolates.

    Parameters
    ----------
    run
        A fitted run.
    posterior
        If given, bands of two standard deviations about the posterior's mean are drawn over the range of the data.
    """
    functions = learned_functions(run if posterior is None else posterior, points=POINTS, beyond=BEYOND)
    columns = min(run.data.dof, MAX_COLUMNS)
    rows = [kind for kind in ROWS if any(f.kind == kind for f in functions)]
    labels, speed = _labels(run), momentum_unit(run)
    with styled():
        figure = new_figure(1.2 + 3.9 * columns, 2.3 * len(rows) + 0.5, "What the model has learned, mass 1")
        axes = figure.subplots(len(rows), columns, squeeze=False)
        for row, i in product(range(len(rows)), range(columns)):
            ax, kind = axes[row, i], rows[row]
            colors = SERIES if kind == "mass" else (MODEL,)
            drawn = list(zip((f for f in functions if (f.kind, f.of[-1]) == (kind, i)), colors, strict=False))
            if not drawn:
                ax.set_axis_off()
                continue
            for f, color in drawn:
                _draw(ax, f, color)
            ax.set_ylabel(labels[kind])
            if kind == "friction":
                ax.set_xlabel(with_unit(f"velocity of {run.data.names[i]}", speed))
            else:
                position_axis(ax, run.data, i)
            if kind == "mass":
                captions(ax, [(f"m{f.of[0] + 1}{f.of[1] + 1}", color) for f, color in drawn])
                ax.margins(y=0.3)
        band = [] if posterior is None else [("band: ±2 standard deviations", MODEL)]
        captions(axes[0, 0], [("shaded: where the data are", "#666666"), *band])
        axes[0, 0].margins(y=0.3)
    return figure


def _labels(run: Run) -> dict[str, str]:
    """Label of the vertical axis of each kind of function, with its unit."""
    speed, time = momentum_unit(run), run.data.time_unit
    # The first mass is 1: a speed in rad/s makes forces of rad/s² and energies of rad²/s².
    force = speed + "²" if speed and time not in ("", "1") else ""
    length = "" if run.data.units[0] == "1" else run.data.units[0]
    energy = force.replace(length, f"{length}²", 1) if length else force
    at = " at s = 0" if run.model.config.dissipation else ""
    return {
        "potential": with_unit("potential V", energy), "force": with_unit("force −∂V/∂q", force),
        "friction": with_unit(f"friction{at}", force), "mass": "mass",
        "damping": with_unit(f"damping{at}", f"1/{time}" if time not in ("", "1") else ""),
    }  # fmt: skip


def _draw(ax: Axes, f: LearnedFunction, color: str) -> None:
    ax.axvspan(f.low, f.high, color=SUPPORT, lw=0, zorder=0)
    ax.axhline(0.0, color=MUTED, lw=0.6, zorder=1)
    if f.mean is not None and f.std is not None and bool((known := f.std.isfinite()).any()):
        x, mean, width = f.x[known], f.mean[known], 2 * f.std[known]
        ax.fill_between(x, mean - width, mean + width, color=color, alpha=0.25, lw=0, zorder=2)
    ax.plot(f.x, f.value, color=color, zorder=3)
    ax.set_xlim(float(f.x[0]), float(f.x[-1]))
