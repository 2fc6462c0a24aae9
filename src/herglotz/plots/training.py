"""How a run was fitted: the cost of every iteration, the plan with its reasons, and the models that were compared."""

from __future__ import annotations

import math
from itertools import groupby
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.ticker import MaxNLocator

from herglotz.data.units import common_unit
from herglotz.errors import InputError
from herglotz.models import refuse_own
from herglotz.plots.style import INK, MODEL, MUTED, SUPPORT, UNSEEN, label, logarithmic, new_figure, styled, with_unit
from herglotz.training import Run
from herglotz.training.plan import Plan
from herglotz.training.selection import Selection

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


# Width of the figure, height of a line of text, and distance of two boxes. [inches]
WIDTH, LINE, GAP = 7.4, 0.16, 0.14
# Characters in a line of a decision and of a reason.
DECISION, REASON = 26, 62


def plot_plan(run: Run) -> Figure:
    """Draw a box for the decisions of each reason, the reason beside the box, and arrows between the boxes.

    Raise InputError if the run holds no plan.
    """
    refuse_own(run.model, "plan", 'run.plot("training") draws the stages of its fit')
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


def plot_sizes(run: Run) -> Figure:
    """Draw the held-out error over the longest segments against the number of parameters, a point a model.

    The line joins the best models of each size, and the model that was taken is in colour. Raise InputError if the
    run has no search for terms.
    """
    refuse_own(run.model, "search for terms", 'run.plot("training") draws the stages of its fit')
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
