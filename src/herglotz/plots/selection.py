"""Held-out error of each level of the ladder, by which `select` chooses."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

from herglotz.data.units import common_unit
from herglotz.plots.style import MODEL, MUTED, UNSEEN, label, logarithmic, new_figure, styled, with_unit

if TYPE_CHECKING:
    from herglotz.training.selection import Selection


def plot_selection(selection: Selection) -> Figure:
    """Draw one column a level: the held-out RMS of every seed, and the median; the chosen level in colour."""
    candidates = selection.candidates
    finite = [x for c in candidates for x in c.of_seeds.tolist() if math.isfinite(x)]
    ceiling = 3 * max(finite)
    with styled():
        figure = new_figure(7.2, 4.2, f"The {selection.chosen.level} level is the simplest that is not beaten")
        ax = figure.subplots()
        for k, c in enumerate(candidates):
            color = UNSEEN if c is selection.chosen else MODEL
            values = [min(x, ceiling) for x in c.of_seeds.tolist()]
            failed = [x >= ceiling for x in values]
            ax.plot([k] * len(values), values, "o", color=color, alpha=0.45, ms=6)
            ax.plot([k - 0.22, k + 0.22], [min(c.error, ceiling)] * 2, color=color, lw=2.4)
            text = f"{c.error:.3g}" if math.isfinite(c.error) else "failed"
            label(ax, k + 0.22, min(c.error, ceiling), text, color, va="center", xytext=(5, 0))
            if any(failed) and math.isfinite(c.error):
                label(ax, k, ceiling, f"{sum(failed)} failed", MUTED, ha="center", xytext=(0, 6))
        logarithmic(ax)
        # The axis spans at least a decade, so that differences of a few per cent look small.
        ax.set_ylim(min(finite) / 3, 1.5 * ceiling)
        names = [f"{c.level}\n{c.parameters} parameters\n{c.step_us:.0f} µs a step" for c in candidates]
        ax.set_xticks(range(len(names)), names)
        ax.set(xlim=(-0.6, len(names) - 0.3), ylabel=with_unit("held-out RMS", common_unit(selection.run.data.units)))
        ax.grid(axis="y", color="#EEEEEE", lw=0.8)
    return figure
