"""Positions against time: data, the free run of the model, and the residual."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from herglotz.data import Trajectories
from herglotz.data.checks import check_trajectory
from herglotz.data.splits import leading
from herglotz.data.units import as_recorded, common_unit, size
from herglotz.plots.style import INK, MODEL, MUTED, SHADE, UNSEEN, captions, label, new_figure, styled, with_unit
from herglotz.training import Run
from herglotz.training.predict import Prediction

MAX_PANELS, DATA = 4, "#B5B5B5"
# The RMS is written if its part takes more than this part of the axis. The text itself takes 0.15 of the axis in a
# figure of one panel.
MIN_WIDTH_OF_RMS = 0.2
# Shares of a recording that are called by a word.
FRACTIONS = {1 / 4: "quarter", 1 / 3: "third", 1 / 2: "half", 2 / 3: "two thirds", 3 / 4: "three quarters"}


def plot_data(data: Trajectories) -> Figure:
    """Draw the samples of up to four trajectories, or up to four coordinates of a single one; gaps stay open."""
    cells = _cells(data, None)
    data, _ = as_recorded(data)
    with styled():
        figure = new_figure(*_size(len(cells), 2.4), data.summary())
        for ax, (b, i) in zip(_axes(figure, len(cells), 1), cells, strict=True):
            t, q = _readings(data, b, i)
            t_open, q_open = _broken(t, q, data)
            ax[0].plot(t_open, q_open, color=MODEL, lw=0.8, alpha=0.6)
            ax[0].plot(t, q, ".", color=INK, ms=3)
            ax[0].set(ylabel=with_unit(data.names[i], data.units[i]), xlabel=with_unit("time", data.time_unit))
            if len(data) > 1:
                ax[0].set_title(data.label(b), parse_math=False)
    return figure


def plot_trajectory(run: Run, trajectory: int | None = None) -> Figure:
    """Draw data, free run and residual against time; held-out time is shaded.

    The prediction is one rollout of each trajectory, which no later sample corrects. Up to four coordinates of the
    `trajectory` of this number are drawn; None: up to four trajectories spread over the data. Raise InputError if the
    data have no such trajectory.
    """
    if trajectory is not None:
        check_trajectory(trajectory, len(run.data))
    motion = _Motion(run.data, run.prediction, run.train_lengths, ("model, trained here", "model, free run"))
    return _drawn(motion, trajectory_title(run), trajectory)


def plot_prediction(found: Prediction) -> Figure:
    """Draw a recording, the free run of a model that was not fitted to it, and the residual; the free run is shaded.

    Up to four coordinates of a single trajectory are drawn. Of several trajectories up to four are drawn, each by its
    first coordinate.
    """
    counts = (found.warmup,) * len(found.data)
    return _drawn(
        _Motion(found.data, found.states.q, counts, ("state estimated", "free run")), _prediction_title(found)
    )


class _Motion(NamedTuple):
    """Data, positions of the model, the samples of each trajectory that the model has seen, and two captions."""

    data: Trajectories
    model: torch.Tensor  # (N, n)
    counts: Sequence[int]  # (B,)
    # Captions of the model's motion over samples that the model has seen, and over the others.
    words: tuple[str, str]


def _drawn(motion: _Motion, title: str, trajectory: int | None = None) -> Figure:
    data, factor = as_recorded(motion.data)
    motion = motion._replace(data=data, model=motion.model * factor)
    cells = _cells(data, trajectory)
    with styled():
        figure = new_figure(*_size(len(cells), 3.9), title)
        for (b, i), ax in zip(cells, _axes(figure, len(cells), 2), strict=True):
            _draw_motion(motion, b, i, ax[0], ax[1], labelled=(b, i) == cells[0])
            ax[1].set_xlabel(with_unit("time", data.time_unit))
            if len(data) > 1:
                ax[0].set_title(data.label(b), parse_math=False)
    return figure


def _prediction_title(found: Prediction) -> str:
    each = found.rms_per_coordinate
    if each is None:
        return "The free run fails at its first step"
    data, factor = as_recorded(found.data)
    names = zip(data.names, [rms * by for rms, by in zip(each, factor.tolist(), strict=True)], data.units, strict=True)
    text = "Free run: RMS " + ", ".join(f"{name} {size(rms, unit)}" for name, rms, unit in names)
    lost = found.failed_steps
    return text if lost == 0 else f"{text}; {100 * lost:.3g} % not reached"


def trajectory_title(run: Run) -> str:
    """Return the title: the RMS distance of the free run from the samples that the fit has not seen."""
    data, factor = as_recorded(run.data)
    unit, error = common_unit(data.units), (run.prediction * factor - data.q).detach()
    unseen = ~trained_mask(run)
    lost = ~torch.isfinite(error).all(-1)
    if bool(lost.any()):
        row = int(lost.nonzero()[0])
        return f"The free run breaks off at {size(float(data.t[row]), data.time_unit)}"
    rms = float(error[unseen if bool(unseen.any()) else ~unseen].square().mean().sqrt())
    if not bool(unseen.any()):
        return f"Training RMS {size(rms, unit)}; nothing was held out"
    part = float(unseen.double().mean())
    near = min(FRACTIONS, key=lambda x: abs(x - part))
    words = FRACTIONS[near] if abs(near - part) < 0.02 else f"{100 * part:.0f} %"
    return f"Extrapolation RMS {size(rms, unit)} over the unseen {words}"


def trained_mask(run: Run) -> torch.Tensor:
    """Return (N,) bool, which samples were trained on: the first `train_lengths` of every trajectory."""
    return leading(run.data.lengths, run.train_lengths)


def momentum_unit(run: Run) -> str:
    """Return the unit of p: with the first mass fixed at 1, p is a velocity."""
    length, time = run.data.units[0], run.data.time_unit
    if len(set(run.data.units)) > 1:
        return ""
    per_time = "" if time in ("", "1") else f"/{time}"
    length = "" if length in ("", "1") else length
    return f"{length or '1'}{per_time}" if length or per_time else ""


def _draw_motion(motion: _Motion, b: int, i: int, top: Axes, bottom: Axes, *, labelled: bool) -> None:
    data, unit, count = motion.data, motion.data.units[i], motion.counts[b]
    t, q = _readings(data, b, i)
    _, model = _series(data, motion.model, b, i)
    boundary = t[0] if count == 0 else t[-1] if count >= len(t) else 0.5 * (t[count - 1] + t[count])
    if count < len(t):
        for ax in (top, bottom):
            ax.axvspan(boundary, t[-1], color=SHADE, lw=0, zorder=0)
    # The points are wide and pale, so that the line of the model does not hide the data.
    top.plot(t, q, ".", color=DATA, ms=7, mew=0, zorder=2)
    seen, unseen = slice(0, max(count, 0)), slice(max(count - 1, 0), None)
    top.plot(t[seen], model[seen], color=MODEL, lw=1.2, zorder=3)
    if count < len(t):
        top.plot(t[unseen], model[unseen], color=UNSEEN, lw=1.2, zorder=3)
    low, high = np.nanmin(np.r_[q, model[np.isfinite(model)]]), np.nanmax(np.r_[q, model[np.isfinite(model)]])
    top.set_ylim(low - 0.06 * (high - low) - 1e-12, high + 0.24 * (high - low) + 1e-12)
    top.set_ylabel(with_unit(data.names[i], unit))
    top.tick_params(labelbottom=False)
    residual = q - model
    bottom.axhline(0.0, color=MUTED, lw=0.8, zorder=1)
    for span, color in ((slice(0, count), MODEL), (slice(count, None), UNSEEN)):
        bottom.plot(t[span], residual[span], ".", color=color, ms=3, zorder=2)
    bottom.set_ylabel(with_unit("residual", unit))
    for ax in (top, bottom):
        ax.set_xlim(t[0], t[-1])
    if labelled:
        captions(top, [("● data", "#777777"), *([(f"━ {motion.words[0]}", MODEL)] if count else [])])
    if labelled and count < len(t):
        captions(top, [(f"━ {motion.words[1]}", UNSEEN)], "upper right")
    _write_rms(bottom, t, residual, count, common_unit(data.units))


def _write_rms(bottom: Axes, t: np.ndarray, residual: np.ndarray, count: int, unit: str) -> None:
    """Write the RMS of each part above the residuals."""
    split = 0.0 if count == 0 else (t[min(count, len(t) - 1)] - t[0]) / (t[-1] - t[0])
    reach = float(np.nanmax(np.abs(residual))) if np.isfinite(residual).any() else 0.0
    # The axis goes further up than down: the RMS stands above the points.
    bottom.set_ylim(-1.25 * (reach or 1.0), 1.9 * (reach or 1.0))
    for span, color, where in ((slice(0, count), MODEL, 0.0), (slice(count, None), UNSEEN, split)):
        part = residual[span]
        if np.isfinite(part).any() and (where or split == 0.0 or split > MIN_WIDTH_OF_RMS):
            text = f"RMS {size(math.sqrt(float(np.nanmean(part**2))), unit)}"
            place = {"xycoords": bottom.get_xaxis_transform(), "xytext": (5, -2), "va": "top"}
            label(bottom, t[0] + where * (t[-1] - t[0]), 1.0, text, color, **place)


def _cells(data: Trajectories, trajectory: int | None) -> list[tuple[int, int]]:
    """Return (trajectory, coordinate) of each panel: all coordinates of one trajectory, or the first of several."""
    if trajectory is not None or len(data) == 1:
        return [(trajectory or 0, i) for i in range(min(data.dof, MAX_PANELS))]
    chosen = np.linspace(0, len(data) - 1, min(len(data), MAX_PANELS)).round().astype(int)
    return [(int(b), 0) for b in chosen]


def _size(cells: int, height: float) -> tuple[float, float]:
    return (8.0, height + 0.6) if cells == 1 else (10.0, (height if cells == 2 else 1.75 * height) + 0.5)


def _axes(figure: Figure, cells: int, rows: int) -> list[list[Axes]]:
    """Make `cells` groups of panels in at most two columns; the rows of a group share their time axis."""
    columns = 1 if cells == 1 else 2
    lines = math.ceil(cells / columns)
    grid = figure.add_gridspec(lines * rows, columns, height_ratios=[2.4, 1.0][:rows] * lines)
    places = [(rows * (k // columns), k % columns) for k in range(cells)]
    return [[figure.add_subplot(grid[top + r, column]) for r in range(rows)] for top, column in places]


def _series(data: Trajectories, values: torch.Tensor, b: int, i: int) -> tuple[np.ndarray, np.ndarray]:
    rows = slice(data.offsets[b], data.offsets[b] + data.lengths[b])
    return data.t[rows].double().cpu().numpy(), values[rows, i].detach().double().cpu().numpy()


def _readings(data: Trajectories, b: int, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Times of a trajectory, and positions of a coordinate; NaN where a reading is missing."""
    t, q = _series(data, data.q, b, i)
    return t, q if data.observed is None else np.where(_series(data, data.observed, b, i)[1] > 0, q, np.nan)


def _broken(t: np.ndarray, q: np.ndarray, data: Trajectories) -> tuple[np.ndarray, np.ndarray]:
    """Put a NaN into every gap, so that no line crosses the gap."""
    at = np.nonzero(np.diff(t) > 1.5 * data.typical_step)[0] + 1
    return np.insert(t, at, np.nan), np.insert(q, at, np.nan)
