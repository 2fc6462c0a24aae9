"""The cost of every iteration of a fit, one panel a stage."""

from __future__ import annotations

import math
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from herglotz.errors import InputError
from herglotz.plots.style import MODEL, MUTED, logarithmic, new_figure, styled

if TYPE_CHECKING:
    from herglotz.training import Run

# Name of a stage, and the cost of every iteration.
Stage = tuple[str, list[float]]
MAX_PANELS, MAX_COLUMNS = 12, 4
# A stage has settled if its last iteration changed the cost by at most this part of the stage's whole decrease.
SETTLED = 0.01


def plot_training(run: Run) -> Figure:
    """Draw the cost of every iteration, a panel a stage, since each stage minimises another cost.

    The last twelve stages are drawn. A panel says "settled" if the last iteration changed the cost by at most 1 % of
    the stage's whole decrease. Raise InputError if the run has no history.
    """
    if not run.history:
        raise InputError("the run has no history of its cost; fit it again to get one")
    costs = [(name, [float(row["cost"]) for row in rows]) for name, rows in groupby(run.history, lambda r: r["stage"])]
    # A stage with a single cost made no iteration.
    stages = [stage for stage in costs if len(stage[1]) > 1] or costs
    shown = stages[-MAX_PANELS:]
    columns = min(MAX_COLUMNS, len(shown))
    rows = math.ceil(len(shown) / columns)
    with styled():
        figure = new_figure(max(4.8, 2.6 * columns), 1.0 + 2.1 * rows, _title(stages, len(shown)))
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for k, (ax, stage) in enumerate(zip(axes, shown, strict=False)):
            _draw(ax, len(stages) - len(shown) + k + 1, stage)
        for ax in axes[len(shown) :]:
            ax.set_axis_off()
        for ax in axes[::columns]:
            ax.set_ylabel("cost")
        for ax in axes[: len(shown)][-columns:]:
            ax.set_xlabel("iteration of the stage")
    return figure


def settled(cost: list[float]) -> bool:
    """True if the last iteration changed the cost by at most 1 % of the stage's whole decrease."""
    return len(cost) > 2 and abs(cost[-2] - cost[-1]) <= SETTLED * (max(cost) - min(cost))


def _draw(ax: Axes, number: int, stage: Stage) -> None:
    name, cost = stage
    y = np.array(cost)
    ax.plot(np.arange(len(y)), y, color=MODEL, marker="o", ms=3 if len(y) < 60 else 0)
    if (y > 0).all() and np.isfinite(y).all() and y.max() > 3 * y.min():
        logarithmic(ax)
    else:
        ax.ticklabel_format(axis="y", useOffset=False)
    ax.xaxis.set_major_locator(MaxNLocator(4, integer=True))
    ax.tick_params(labelsize=8)
    ax.set_title(f"{number}  {_short(name)}", fontsize=8.5)
    ax.text(0.97, 0.95, "settled" if settled(cost) else f"ends at {cost[-1]:.3g}", transform=ax.transAxes, ha="right",
            va="top", fontsize=8.5, color=MUTED)  # fmt: skip
    ax.grid(axis="y", color="#EEEEEE", lw=0.8)


def _title(stages: list[Stage], shown: int) -> str:
    count, plural = sum(len(cost) - 1 for _, cost in stages), "" if len(stages) == 1 else "s"
    last = f", the last {shown} shown" if shown < len(stages) else ""
    end = ": the last one has settled" if settled(stages[-1][1]) else ""
    return f"{count} iterations in {len(stages)} stage{plural}{last}{end}"


def _short(name: str) -> str:
    return name if len(name) <= 28 else name[:27] + "…"
