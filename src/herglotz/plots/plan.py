"""The plan of a fit: its decisions in order, with their reasons."""

from __future__ import annotations

from textwrap import fill
from typing import TYPE_CHECKING

from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

from herglotz.data.units import common_unit
from herglotz.errors import InputError
from herglotz.plots.style import INK, MODEL, MUTED, SUPPORT, new_figure, styled
from herglotz.training.plan import Plan

if TYPE_CHECKING:
    from herglotz.training import Run

# Width of the figure, height of a line of text, and distance of two boxes. [inches]
WIDTH, LINE, GAP = 7.4, 0.16, 0.14
# Characters in a line of a decision and of a reason.
DECISION, REASON = 26, 62


def plot_plan(run: Run) -> Figure:
    """Draw a box for the decisions of each reason, the reason beside the box, and arrows between the boxes.

    Raise InputError if the run holds no plan.
    """
    if "plan" not in run.metrics:
        raise InputError("the run holds no plan; fit it again to get one")
    plan = Plan.from_dict(run.metrics["plan"])
    rows = [
        ("\n".join(fill(words, DECISION) for words in decisions), fill(reason, REASON))
        for decisions, reason in plan.by_reason(common_unit(run.data.units))
        if reason
    ]
    heights = [LINE * max(left.count("\n") + 1, right.count("\n") + 1) + 0.1 for left, right in rows]
    total = sum(heights) + GAP * (len(rows) + 1)
    with styled():
        figure = new_figure(WIDTH, total + 0.45, f"What was decided for {run.data.source or 'the data'}, and why")
        ax = figure.subplots()
        ax.set(xlim=(0, WIDTH), ylim=(-total, 0))
        ax.set_axis_off()
        top = -GAP
        for k, ((left, right), height) in enumerate(zip(rows, heights, strict=True)):
            box = FancyBboxPatch((0.1, top - height), 2.6, height, "round,pad=0.02", fc=SUPPORT, ec=MODEL, lw=0.8)
            ax.add_patch(box)
            ax.text(1.4, top - height / 2, left, ha="center", va="center", color=INK, fontsize=8.5)
            ax.text(2.95, top - height / 2, right, ha="left", va="center", color="#555555", fontsize=8.5)
            if k + 1 < len(rows):
                arrow = {"arrowstyle": "-|>", "color": MUTED, "lw": 0.8}
                ax.annotate("", (1.4, top - height - GAP), (1.4, top - height), arrowprops=arrow)
            top -= height + GAP
    return figure
