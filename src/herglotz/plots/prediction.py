"""A recording beside the free run of a model that has not seen it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from herglotz.plots.style import MODEL, MUTED, SHADE, UNSEEN, captions, new_figure, number, styled, with_unit

if TYPE_CHECKING:
    from herglotz.training.predict import Prediction

MOST_PANELS, DATA = 4, "#B5B5B5"


def plot_prediction(found: Prediction) -> Figure:
    """Draw data, free run and their difference against time; the warm-up is not shaded.

    A single trajectory shows up to four coordinates; several show their first, four of them spread over the set.
    """
    data = found.data
    cells = [(0, i) for i in range(min(data.dof, MOST_PANELS))]
    if len(data) > 1:
        chosen = np.linspace(0, len(data) - 1, min(len(data), MOST_PANELS)).round().astype(int)
        cells = [(int(b), 0) for b in chosen]
    with styled():
        figure = new_figure(9.0, 0.6 + 2.3 * len(cells), _title(found))
        grid = figure.add_gridspec(2 * len(cells), 1, height_ratios=[2.4, 1.0] * len(cells))
        for k, (b, i) in enumerate(cells):
            top, bottom = figure.add_subplot(grid[2 * k]), figure.add_subplot(grid[2 * k + 1])
            _draw(found, b, i, top, bottom)
            if k == 0:
                captions(top, [("● data", "#777777"), ("━ state estimated", MODEL), ("━ free run", UNSEEN)])
            if len(data) > 1:
                top.set_title(f"trajectory {b}")
        bottom.set_xlabel(with_unit("time", data.time_unit))
    return figure


def _title(found: Prediction) -> str:
    each = found.rms_per_coordinate
    if each is None:
        return "The free run fails at its first step"
    names = zip(found.data.names, each, found.data.units, strict=True)
    text = "Free run: RMS " + ", ".join(f"{name} {number(rms, unit)}" for name, rms, unit in names)
    lost = found.failed_steps
    return text if lost == 0 else f"{text}; {100 * lost:.3g} % not reached"


def _draw(found: Prediction, b: int, i: int, top: Axes, bottom: Axes) -> None:
    data, k = found.data, found.warmup
    rows = slice(data.offsets[b], data.offsets[b] + data.lengths[b])
    t, q, model = (x[rows].double().numpy() for x in (data.t, data.q[:, i], found.states.q[:, i]))
    for ax in (top, bottom):
        ax.axvspan(t[k - 1], t[-1], color=SHADE, lw=0, zorder=0)
        ax.set_xlim(t[0], t[-1])
    top.plot(t, q, ".", color=DATA, ms=7, mew=0, zorder=2)
    top.plot(t[:k], model[:k], color=MODEL, zorder=3)
    top.plot(t[k - 1 :], model[k - 1 :], color=UNSEEN, zorder=3)
    low, high = float(q.min()), float(q.max())
    room = (high - low) or 1.0
    top.set_ylim(low - 0.1 * room, high + 0.3 * room)
    top.set_ylabel(with_unit(data.names[i], data.units[i]))
    top.tick_params(labelbottom=False)
    bottom.axhline(0.0, color=MUTED, lw=0.8, zorder=1)
    bottom.plot(t[:k], (q - model)[:k], ".", color=MODEL, ms=3)
    bottom.plot(t[k:], (q - model)[k:], ".", color=UNSEEN, ms=3)
    bottom.set_ylabel(with_unit("residual", data.units[i]))
