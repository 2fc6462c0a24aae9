"""Error against cost of every setting that `tune` tried, with the Pareto front."""

from __future__ import annotations

import math
from itertools import product

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from herglotz.data.units import common_unit
from herglotz.plots.style import ACCENT, INK, MODEL, MUTED, UNSEEN, label, new_figure, styled, with_unit
from herglotz.tune.result import Candidate, Tuning

# The axis is logarithmic: an error of 0, that of the run's own setting, is drawn here.
FLOOR = 1e-16
KINDS = (
    ("eager", "float64", "o", MUTED, "PyTorch"),
    ("c", "float64", "s", MODEL, "C, float64"),
    ("c", "float32", "^", ACCENT, "C, float32"),
)
# Forms of a step, and how their marks are filled.
FORMS = (("own model", "none"), ("distilled", "full"), ("kicks", "left"))


def _form(candidate: Candidate) -> str:
    if candidate.kicks is not None:
        return "kicks"
    return "own model" if candidate.setting.width is None else "distilled"


def plot_tuning(tuning: Tuning) -> Figure:
    """Draw the error bound against the cost; marks of distilled models are filled, and a circle marks the choice."""
    good = [c for c in tuning.candidates if math.isfinite(c.bound)]
    share, unit = f"{100 * tuning.config.quantile:g} % of starts", tuning.run.data.time_unit
    chosen = tuning.chosen
    before, what = (tuning.own, "the run as it is") if tuning.own_in_c is None else (tuning.own_in_c, "the same in C")
    with styled():
        figure = new_figure(
            7.6, 4.8, f"{before.us / chosen.us:.3g} times cheaper than {what}, within {chosen.bound:.2g}"
        )
        ax = figure.subplots()
        front = tuning.front
        ax.step([c.us for c in front], [max(c.bound, FLOOR) for c in front], where="post", color=INK, lw=0.9)
        for (artefact, dtype, mark, color, name), (form, fill) in product(KINDS, FORMS):
            kind = (artefact, dtype, form)
            some = [c for c in good if (c.setting.artefact, c.setting.dtype, _form(c)) == kind]
            x, y = [c.us for c in some], [max(c.bound, FLOOR) for c in some]
            text = f"{name}, {form}" if some else None
            ax.plot(x, y, mark, color=color, fillstyle=fill, ms=6, ls="", label=text)
        ax.plot([chosen.us], [max(chosen.bound, FLOOR)], "o", ms=14, mfc="none", mec=UNSEEN, mew=2)
        label(ax, chosen.us, max(chosen.bound, FLOOR), chosen.setting.name, UNSEEN, xytext=(10, -18))
        _draw_limits(ax, tuning)
        ax.set(xscale="log", yscale="log", xlabel=f"cost (µs per {'unit of time' if unit == '1' else unit})")
        ax.set_ylabel(with_unit(f"error that {share} keep", common_unit(tuning.run.data.units)))
        ax.grid(color="#EEEEEE", lw=0.8)
        ax.legend(fontsize=8, loc="best")
    return figure


def _draw_limits(ax: Axes, tuning: Tuning) -> None:
    """Draw the error or the cost that the user asked for, and the error of the model against its data."""
    if "max_error" in tuning.asked:
        ax.axhline(tuning.asked["max_error"], color=UNSEEN, lw=0.9, ls="--")
    else:
        ax.axvline(tuning.asked["budget_us"], color=UNSEEN, lw=0.9, ls="--")
    known = tuning.model_error["extrapolation_rms"] or tuning.model_error["train_rms"]
    if known:
        ax.axhline(known, color=MUTED, lw=0.9, ls=":")
        right = max(c.us for c in tuning.candidates if math.isfinite(c.bound))
        label(ax, right, known, "RMS of the model against its data", MUTED, ha="right")
