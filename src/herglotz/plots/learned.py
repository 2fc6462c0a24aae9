"""What was learned: functions of the model along each coordinate, and the bands of its posterior."""

from __future__ import annotations

from itertools import product
from statistics import NormalDist

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from herglotz.data.units import as_recorded
from herglotz.plots.motion import momentum_unit, trained_mask
from herglotz.plots.style import (
    MODEL,
    MUTED,
    SERIES,
    SHADE,
    SUPPORT,
    UNSEEN,
    captions,
    new_figure,
    position_axis,
    styled,
    with_unit,
)
from herglotz.training import Bands, Laplace, Run
from herglotz.training.learned_functions import LearnedFunction, learned_functions

MAX_COLUMNS, POINTS = 3, 161
# Functions are drawn beyond the data, on both sides by this part of the data's range.
BEYOND = 0.25
ROWS = ("potential", "force", "friction", "damping", "mass")


def plot_learned(run: Run, posterior: Laplace | None = None) -> Figure:
    """Draw the functions that a run has learned, along each coordinate with the others at their median.

    The functions are V(q_i), the force −∂V/∂q_i, friction over the velocity, and, if they depend on position, damping
    and the entries m_jk of the mass (`herglotz.training.learned_functions`). The mean of the first mass over the data
    is 1, so that forces are accelerations of the first coordinate. The range of the data is shaded: the mean of V over
    this range is 0, and beyond the range the model extrapolates. With a `posterior`, bands of two standard deviations
    about its mean are drawn over the range of the data.
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


# More panels are too small to read.
MAX_PANELS = 4


def plot_bands(run: Run, bands: Bands, level: float = 0.9) -> Figure:
    """Draw data − model against time, with the bands of the model's position and of a measured value.

    At most four panels: the coordinates of the first trajectory, then those of the next. Panels of the same unit have
    the same scale.
    """
    inside, held_out = bands.inside(run.data.unwrapped().q, level), ~trained_mask(run)
    data, factor = as_recorded(run.data.unwrapped())
    part, word = (held_out, "held-out ") if bool(held_out.any()) else (~held_out, "")
    share = 100 * float(inside[part].double().mean())
    title = f"{share:.0f} % of the {word}samples lie in the {100 * level:g} % band"
    cells = [(b, i) for b in range(len(data)) for i in range(data.dof)][:MAX_PANELS]
    width = NormalDist().inv_cdf(0.5 + level / 2)
    with styled():
        figure = new_figure(8.0, 1.2 + 1.9 * len(cells), title)
        axes, reaches = figure.subplots(len(cells), 1, squeeze=False)[:, 0], []
        for (b, i), ax in zip(cells, axes, strict=True):
            by = float(factor[i])
            rows = slice(data.offsets[b], data.offsets[b] + data.lengths[b])
            t, residual = data.t[rows].cpu(), (data.q - bands.q * factor)[rows, i].cpu()
            model = width * bands.std[rows, i].cpu() * by
            measured = (model.square() + (width * float(bands.sigma[i]) * by) ** 2).sqrt()
            trained = run.train_lengths[b]
            if trained < len(t):
                ax.axvspan(float(t[trained - 1] + t[trained]) / 2, float(t[-1]), color=SHADE, lw=0, zorder=0)
            ax.fill_between(t, -measured, measured, color=MODEL, alpha=0.18, lw=0, zorder=1)
            ax.fill_between(t, -model, model, color=MODEL, alpha=0.45, lw=0, zorder=2)
            ax.axhline(0.0, color=MUTED, lw=0.8, zorder=3)
            ax.plot(t[:trained], residual[:trained], ".", color=MODEL, ms=4, zorder=4)
            ax.plot(t[trained:], residual[trained:], ".", color=UNSEEN, ms=4, zorder=4)
            ax.set_xlim(float(t[0]), float(t[-1]))
            reaches.append(float(max(residual.abs().max(), measured.max())))
            if len(data) > 1:
                ax.set_title(data.label(b), parse_math=False)
            ax.set_ylabel(with_unit(f"residual of {data.names[i]}", data.units[i]))
        units = [data.units[i] for _, i in cells]
        # Panels of the same unit have the same scale, so that a reader can compare them.
        for ax, unit in zip(axes, units, strict=True):
            largest = max(reach for reach, other in zip(reaches, units, strict=True) if other == unit)
            ax.set_ylim(-1.5 * largest, 1.5 * largest)
        captions(axes[0], [("● training", MODEL), ("● held out", UNSEEN), ("dark: model, light: measurement", MUTED)])
        axes[-1].set_xlabel(with_unit("time", data.time_unit))
    return figure
