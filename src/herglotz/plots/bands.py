"""Residuals of a run, and the predictive bands of its posterior."""

from __future__ import annotations

from statistics import NormalDist
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from herglotz.data.units import as_recorded
from herglotz.plots.motion import trained_mask
from herglotz.plots.style import MODEL, MUTED, SHADE, UNSEEN, captions, new_figure, styled, with_unit

if TYPE_CHECKING:
    from herglotz.training import Bands, Run

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
                ax.set_title(f"trajectory {b}")
            ax.set_ylabel(with_unit(f"residual of {data.names[i]}", data.units[i]))
        units = [data.units[i] for _, i in cells]
        # Panels of the same unit have the same scale, so that a reader can compare them.
        for ax, unit in zip(axes, units, strict=True):
            largest = max(reach for reach, other in zip(reaches, units, strict=True) if other == unit)
            ax.set_ylim(-1.5 * largest, 1.5 * largest)
        captions(axes[0], [("● training", MODEL), ("● held out", UNSEEN), ("dark: model, light: measurement", MUTED)])
        axes[-1].set_xlabel(with_unit("time", data.time_unit))
    return figure
