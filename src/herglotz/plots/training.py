"""The cost while training, stage by stage."""

from __future__ import annotations

from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from herglotz.errors import InputError
from herglotz.plots.style import SERIES, new_figure, styled

if TYPE_CHECKING:
    from herglotz.training import Run


def plot_training(run: Run) -> Figure:
    """Draw the cost of every iteration; a stage minimises its own cost, so lines of two stages are not joined.

    Raises
    ------
    InputError
        If the run has no history.
    """
    if not run.history:
        raise InputError("the run has no history of its cost; fit it again to get one")
    stages = [(name, list(rows)) for name, rows in groupby(run.history, key=lambda row: str(row["stage"]))]
    with styled():
        figure = new_figure(8.0, 3.8, _title(run.history, stages))
        ax = figure.add_subplot()
        start = 0
        for k, (name, rows) in enumerate(stages):
            x = start + np.arange(len(rows))
            y = np.array([float(row["cost"]) for row in rows])
            color = SERIES[k % len(SERIES)]
            ax.plot(x, y, "-", color=color, marker="o", ms=3 if len(x) < 60 else 0)
            if k:
                ax.axvline(start - 0.5, color="#CCCCCC", lw=0.8, zorder=0)
            ax.text(
                start - 0.3, 1.0, _short(name), color=color, fontsize=8.5, va="bottom", ha="left",
                rotation=0 if len(stages) < 4 else 25, transform=ax.get_xaxis_transform(),
            )  # fmt: skip
            start += len(rows)
        costs = np.array([float(row["cost"]) for row in run.history])
        if (costs > 0).all() and np.isfinite(costs).all():
            ax.set_yscale("log")
        ax.set(xlabel="iteration, all stages", ylabel="cost (each stage its own)", xlim=(-0.8, max(start - 0.2, 1)))
        ax.grid(axis="y", color="#EEEEEE", lw=0.8)
    return figure


def _title(history: list[dict], stages: list[tuple[str, list[dict]]]) -> str:
    count, plural = len(history), "" if len(stages) == 1 else "s"
    last = [float(row["cost"]) for row in stages[-1][1]]
    message = f"{count} iterations in {len(stages)} stage{plural}"
    settled = len(last) > 2 and abs(last[-2] - last[-1]) <= 1e-3 * abs(last[-1])
    return message + (": the cost has settled" if settled else "")


def _short(name: str) -> str:
    return name if len(name) <= 24 else name[:23] + "…"
