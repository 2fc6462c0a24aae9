"""The phase portrait: the data's states over the flow of the learned model."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from herglotz.plots.fan import units
from herglotz.plots.motion import trained_mask
from herglotz.plots.style import INK, MODEL, MUTED, UNSEEN, corner, new_figure, styled, with_unit
from herglotz.stepping import Rollout, State, Stepper

if TYPE_CHECKING:
    from herglotz.training import Run

LINES, STEPS, MOST_PANELS = 9, 60, 3
NEAR_PI = 1.6  # an angle that goes further than this is drawn with ±π in sight


def plot_phase_portrait(run: Run) -> Figure:
    """Draw momentum against position, one panel a coordinate: states at the samples over rollouts of the model.

    The grey lines are rollouts from a grid of starts where the motion does not depend on s, and from the first state of
    each trajectory otherwise (or with more than one coordinate, where a start needs all of them).
    """
    data = run.data
    panels = min(data.dof, MOST_PANELS)
    with styled():
        figure = new_figure(5.6 if panels == 1 else 4.2 * panels, 4.6, _title(run))
        for i in range(panels):
            ax = figure.add_subplot(1, panels, i + 1)
            _draw_panel(run, i, ax)
    return figure


def _draw_panel(run: Run, i: int, ax: Axes) -> None:
    data, unit = run.data, units(run)[0]
    q, p = (x[:, i].detach().double().cpu().numpy() for x in (run.states.q, run.states.p))
    fine = np.isfinite(q) & np.isfinite(p)
    (q_low, q_high), (p_low, p_high) = _limits(q[fine], data.angles[i]), _limits(p[fine], False)
    for line in _background(run, (q_low, q_high), (p_low, p_high)):
        _draw_line(ax, line[:, 0, i], line[:, 1, i])
    seen = trained_mask(run).numpy()
    for mask, color in ((fine & seen, MODEL), (fine & ~seen, UNSEEN)):
        ax.plot(q[mask], p[mask], ".", ms=3.2, color=color, zorder=3)
    ax.plot(q[list(data.offsets)], p[list(data.offsets)], "o", ms=5, mfc="white", mec=INK, mew=1.0, zorder=4)
    ax.set(xlim=(q_low, q_high), ylim=(p_low, p_high), xlabel=with_unit(data.names[i], data.units[i]))
    ax.set_ylabel(with_unit(f"momentum p_{data.names[i]}", unit and f"{unit}, mass 1"))
    if data.angles[i]:
        _mark_pi(ax, q_low, q_high)
    if i == 0:
        corner(ax, "● state at a sample, trained", MODEL)
        if bool((~seen).any()):
            corner(ax, "● unseen", UNSEEN, x=1.0)
        corner(ax, "○ start    → flow of the model", MUTED, y=0.0)


def _background(run: Run, q_range: tuple[float, float], p_range: tuple[float, float]) -> np.ndarray:
    """(lines, STEPS + 1, 2, n) positions and momenta of rollouts; NaN after a step that failed."""
    model, data = run.model, run.data
    starts = [x[list(data.offsets)].detach() for x in run.states]
    if data.dof == 1 and not model.s_enters_motion:
        like = run.states.q
        q = torch.linspace(*q_range, LINES, dtype=like.dtype, device=like.device)
        p = torch.linspace(*p_range, LINES, dtype=like.dtype, device=like.device)
        grid = torch.cartesian_prod(q, p)
        starts = [grid[:, :1], grid[:, 1:], torch.zeros_like(grid[:, 0])]
    with torch.no_grad():
        found: Rollout = Stepper(model).rollout(*State(*starts), h=run.h, steps=STEPS)
    return torch.stack([found.q, found.p], -2).double().cpu().numpy()


def _draw_line(ax: Axes, q: np.ndarray, p: np.ndarray) -> None:
    """A thin line with one arrow head, so that the direction of time is seen."""
    fine = np.isfinite(q) & np.isfinite(p)
    q, p = q[fine], p[fine]
    if len(q) < 2:
        return
    ax.plot(q, p, color=MUTED, lw=0.5, alpha=0.55, zorder=1)
    at = min(2, len(q) - 2)
    ax.annotate(
        "",
        (q[at + 1], p[at + 1]),
        (q[at], p[at]),
        arrowprops={"arrowstyle": "-|>", "color": MUTED, "lw": 0.5, "mutation_scale": 6, "alpha": 0.8},
        annotation_clip=True,
        zorder=1,
    )


def _limits(x: np.ndarray, angle: bool) -> tuple[float, float]:
    low, high = (float(x.min()), float(x.max())) if len(x) else (-1.0, 1.0)
    if angle and max(-low, high) > NEAR_PI:
        low, high = min(low, -math.pi), max(high, math.pi)
    margin = 0.08 * (high - low) or 1.0
    return low - margin, high + margin


def _mark_pi(ax: Axes, low: float, high: float) -> None:
    """Lines at the odd multiples of π in sight, where a pendulum stands upright; ticks in multiples of π."""
    for k in range(math.ceil(low / math.pi), math.floor(high / math.pi) + 1):
        if k % 2:
            ax.axvline(k * math.pi, color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=0)
    if high - low > 2 * math.pi:
        every = max(1, round((high - low) / (6 * math.pi)))
        ks = [k for k in range(math.ceil(low / math.pi), math.floor(high / math.pi) + 1) if k % every == 0]
        names = {0: "0", 1: "π", -1: "−π"}
        ax.set_xticks([k * math.pi for k in ks], [names.get(k, f"{k}π".replace("-", "−")) for k in ks])


def _title(run: Run) -> str:
    """How much of the momentum one unit of time leaves, where the model has one damping rate."""
    damping = getattr(run.model, "damping", None)
    rate = getattr(damping, "rate", None)
    if rate is None or not getattr(damping, "constant", False):
        return "States and flow of the learned model"
    unit = "" if run.data.time_unit in ("", "1") else f" per {run.data.time_unit}"
    return f"States decay along the learned flow: γ = {rate.item():.3g}{unit}"
