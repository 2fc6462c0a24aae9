"""The cost while training, stage by stage."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from herglotz.errors import InputError
from herglotz.plots.style import SERIES, new_figure, styled

if TYPE_CHECKING:
    from herglotz.training import Run

Stage = tuple[str, list[float]]  # name and costs
MOST_NAMES = 24
SETTLED = 1e-12  # a smaller relative excess is round-off and not drawn


def plot_training(run: Run) -> Figure:
    """Draw the cost of every iteration; a stage minimises its own cost, so lines of two stages are not joined.

    Below: how far each cost is from the last of its stage, relative to it; a straight fall is linear convergence.

    Raises
    ------
    InputError
        If the run has no history.
    """
    if not run.history:
        raise InputError("the run has no history of its cost; fit it again to get one")
    stages = [(name, [float(row["cost"]) for row in rows]) for name, rows in groupby(run.history, lambda r: r["stage"])]
    with styled():
        figure = new_figure(8.6, 5.0, _title(stages))
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[1.2, 1.0])
        start = 0
        for k, (_, cost) in enumerate(stages):
            x, y = start + np.arange(len(cost)), np.array(cost)
            style = {"color": SERIES[k % len(SERIES)], "marker": "o", "ms": 3 if len(run.history) < 300 else 0}
            top.plot(x, y, **style)
            excess = y / y[-1] - 1.0 if y[-1] else y
            bottom.plot(x, np.where(excess > SETTLED, excess, np.nan), **style)
            for ax in (top, bottom) if k else ():
                ax.axvline(start - 0.5, color="#CCCCCC", lw=0.8, zorder=0)
            start += len(cost)
        _label_stages(top, stages)
        everything = np.concatenate([cost for _, cost in stages])
        if (everything > 0).all() and np.isfinite(everything).all():
            top.set_yscale("log")
            bottom.set_yscale("log")
        top.set(ylabel="cost (each stage its own)", xlim=(-0.8, max(start - 0.2, 1)))
        bottom.set(ylabel="excess over the stage's last cost", xlabel="iteration, all stages")
        for ax in (top, bottom):
            ax.grid(axis="y", color="#EEEEEE", lw=0.8)
    return figure


def _label_stages(ax: Axes, stages: list[Stage]) -> None:
    """Name each stage over its part; with many stages a number there, and the names beside the panel."""
    many, start = len(stages) > 4, 0
    for k, (name, cost) in enumerate(stages):
        color = SERIES[k % len(SERIES)]
        options: Any = {"color": color, "fontsize": 8.5}
        text = str(k + 1) if many else _short(name)
        middle = start + (len(cost) - 1) / 2
        ax.text(middle, 1.01, text, ha="center", va="bottom", transform=ax.get_xaxis_transform(), **options)
        if many and k < MOST_NAMES:
            ax.text(1.01, 1.0 - 0.085 * k, f"{k + 1}  {_short(name)}", va="top", transform=ax.transAxes, **options)
        start += len(cost)


def _title(stages: list[Stage]) -> str:
    count, plural = sum(len(cost) for _, cost in stages), "" if len(stages) == 1 else "s"
    last = stages[-1][1]
    settled = len(last) > 2 and abs(last[-2] - last[-1]) <= 1e-3 * abs(last[-1])
    return f"{count} iterations in {len(stages)} stage{plural}" + (": the cost has settled" if settled else "")


def _short(name: str) -> str:
    return name if len(name) <= 24 else name[:23] + "…"
