"""Held-out error against the number of parameters, for the models that a search for terms compared."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from herglotz.data.units import common_unit
from herglotz.errors import InputError
from herglotz.plots.style import MODEL, MUTED, UNSEEN, label, logarithmic, new_figure, styled, with_unit

if TYPE_CHECKING:
    from herglotz.training import Run


def plot_sizes(run: Run) -> Figure:
    """Draw the held-out error over the longest segments against the number of parameters, a point a model.

    The line joins the best models of each size, and the model that was taken is in colour. Raise InputError if the
    run has no search for terms.
    """
    compared = run.metrics.get("compared")
    if not compared:
        raise InputError("the run has no search for terms whose models could be drawn; fit without naming terms")
    numbers, errors = (np.array([row[name] for row in compared]) for name in ("numbers", "held_out"))
    taken = next(row for row in compared if row["taken"])
    sizes = np.unique(numbers)
    best = [errors[numbers == size].min() for size in sizes]
    with styled():
        title = f"Held-out time asks for {taken['numbers']} numbers; {len(compared)} models were compared"
        figure = new_figure(7.2, 4.2, title)
        ax = figure.subplots()
        ax.plot(numbers, errors, "o", color=MUTED, alpha=0.5, ms=5)
        ax.plot(sizes, best, color=MODEL)
        ax.plot(taken["numbers"], taken["held_out"], "o", color=UNSEEN, ms=9)
        label(ax, taken["numbers"], taken["held_out"], "taken", UNSEEN, ha="center", xytext=(0, -16))
        if min(errors) > 0 and max(errors) > 3 * min(errors):
            logarithmic(ax)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.margins(0.08, 0.15)
        unit = common_unit(run.data.units) if run.data.dof == 1 else ""
        ax.set(xlabel="numbers of the model", ylabel=with_unit("RMS error over held-out blocks", unit))
        ax.grid(axis="y", color="#EEEEEE", lw=0.8)
    return figure
