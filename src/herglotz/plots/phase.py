"""The phase portrait: states at the samples, over the flow of the learned model."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from herglotz.models import ContactLagrangian
from herglotz.plots.motion import momentum_unit, trained_mask
from herglotz.plots.style import INK, MODEL, MUTED, UNSEEN, captions, new_figure, position_axis, styled, with_unit
from herglotz.stepping import State, Stepper
from herglotz.training import Run
from herglotz.training.flow import motion

# Starts of rollouts along each axis of a panel, and panels.
LINES, MAX_PANELS = 13, 3
# Length of a rollout from the grid, in the typical time (range of q) / (range of p), and its largest number of steps.
DURATION, MAX_STEPS = 0.35, 400
# Width of the head of an arrow.
HEAD_INCHES = 0.05
# The panel of an angle that exceeds this reaches to ±π. [rad]
NEAR_PI = 1.6


def plot_phase_portrait(run: Run) -> Figure:
    """Draw momentum against position, one panel a coordinate: states at the samples over rollouts of the model.

    The grey lines are rollouts: of one coordinate whose motion does not depend on s, from a grid of starts; of other
    models, from the first state of each trajectory. A model with inputs has no flow of its own, and no rollouts are
    drawn.
    """
    panels = min(run.data.dof, MAX_PANELS)
    with styled():
        figure, lines = new_figure(5.6 if panels == 1 else 4.2 * panels, 4.6, _title(run)), _background(run)
        for i in range(panels):
            _draw_panel(run, i, figure.add_subplot(1, panels, i + 1), lines[..., i])
    return figure


def _points(run: Run, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions and momenta of a coordinate at the samples, and which samples are finite."""
    q, p = (x[:, i].detach().double().cpu().numpy() for x in (run.states.q, run.states.p))
    return q, p, np.isfinite(q) & np.isfinite(p)


def _draw_panel(run: Run, i: int, ax: Axes, lines: np.ndarray) -> None:
    data, unit, (q, p, fine) = run.data, momentum_unit(run), _points(run, i)
    (q_low, q_high), (p_low, p_high) = _limits(q[fine], data.angles[i]), _limits(p[fine])
    _draw_flow(ax, lines)
    seen = trained_mask(run).numpy()
    for mask, color in ((fine & seen, MODEL), (fine & ~seen, UNSEEN)):
        ax.plot(q[mask], p[mask], ".", ms=3.2, color=color, zorder=3)
    ax.plot(q[list(data.offsets)], p[list(data.offsets)], "o", ms=5, mfc="white", mec=INK, mew=1.0, zorder=4)
    ax.set(xlim=(q_low, q_high), ylim=(p_low, p_high))
    ax.set_ylabel(with_unit(f"momentum p_{data.names[i]}", unit and f"{unit}, mass 1"))
    if data.angles[i]:
        _mark_pi(ax, q_low, q_high)
    position_axis(ax, data, i)
    if i == 0:
        unseen = [("● unseen", UNSEEN)] if bool((~seen).any()) else []
        flow = [] if run.model.inputs else [("→ flow of the model", "#666666")]
        captions(ax, [("○ start", INK), ("● trained", MODEL), *unseen, *flow])


def _background(run: Run) -> np.ndarray:
    """Return positions and momenta of rollouts, (lines, K + 1, 2, n), NaN after a failed step; no lines with inputs."""
    model, data = run.model, run.data
    if model.inputs:
        return np.empty((0, 0, 2, data.dof))
    duration = max(float(one.t[-1] - one.t[0]) for one in data)
    starts = [x[list(data.offsets)].detach() for x in run.states]
    if data.dof == 1 and not model.s_enters_motion:
        like, (q, p, fine) = run.states.q, _points(run, 0)
        q_range, p_range = _limits(q[fine], data.angles[0]), _limits(p[fine])
        q, p = (torch.linspace(*of, LINES, dtype=like.dtype, device=like.device) for of in (q_range, p_range))
        grid, typical = torch.cartesian_prod(q, p), (q_range[1] - q_range[0]) / (p_range[1] - p_range[0])
        starts, duration = [grid[:, :1], grid[:, 1:], torch.zeros_like(grid[:, 0])], DURATION * typical
    steps = max(3, min(MAX_STEPS, round(duration / run.h)))
    h = min(run.h, duration / steps)
    return _flow(model, State(*starts), h, steps).double().cpu().numpy()


def _flow(model: ContactLagrangian, start: State, h: float, steps: int) -> torch.Tensor:
    """Positions and momenta of rollouts, (lines, K + 1, 2, n): by the compiled step if the model has one."""
    with torch.no_grad():
        x = motion(model, start.joined, torch.full((len(start.q), steps), h).to(start.q), None)
        if x is None:
            x = Stepper(model).rollout(*start, h=h, steps=steps).states.joined
    return x[..., : 2 * model.dof].unflatten(-1, (2, model.dof))


def _draw_flow(ax: Axes, lines: np.ndarray) -> None:
    """Draw thin lines, (lines, K + 1, 2), each with an arrow head in the direction of time."""
    # Only the points before a failed step are drawn.
    counts = np.isfinite(lines).all(-1).sum(-1)
    known = [line[:count] for line, count in zip(lines, counts, strict=True) if count > 1]
    if not known:
        return
    ax.add_collection(LineCollection(known, colors=MUTED, lw=0.6, alpha=0.7, zorder=1), autolim=False)
    at = [len(line) - 2 if len(line) < 12 else len(line) // 4 for line in known]
    tip, last = (np.array([line[k + j] for line, k in zip(known, at, strict=True)]) for j in (1, 0))
    way = np.linalg.norm(tip - last, axis=-1)
    # A rollout from a state of rest has no direction.
    moves = way > 0
    ahead = (tip - last)[moves] / way[moves, None]
    head = {"headwidth": 1, "headlength": 1.2, "headaxislength": 1.2, "width": HEAD_INCHES / 1.2}
    head["scale"] = 1 / HEAD_INCHES
    shape: Any = {"angles": "xy", "pivot": "tip", "units": "inches", "scale_units": "inches", **head}
    ax.quiver(*tip[moves].T, *ahead.T, color=MUTED, alpha=0.8, lw=0, zorder=1, **shape)


def _limits(x: np.ndarray, angle: bool | None = None) -> tuple[float, float]:
    low, high = (float(x.min()), float(x.max())) if len(x) else (-1.0, 1.0)
    # Captions stand above the momenta.
    top = 0.08 if angle is not None else 0.18
    if angle and max(-low, high) > NEAR_PI:
        low, high = min(low, -math.pi), max(high, math.pi)
    size = (high - low) or 1.0
    return low - 0.08 * size, high + top * size


def _mark_pi(ax: Axes, low: float, high: float) -> None:
    """Draw lines at the odd multiples of π, where a pendulum stands upright, and ticks in multiples of π."""
    multiples = range(math.ceil(low / math.pi), math.floor(high / math.pi) + 1)
    for k in (k for k in multiples if k % 2):
        ax.axvline(k * math.pi, color=MUTED, lw=0.9, ls=(0, (4, 3)), zorder=0)
    if high - low > 2 * math.pi:
        stride = max(1, round((high - low) / (6 * math.pi)))
        ks = [k for k in multiples if k % stride == 0]
        names = {0: "0", 1: "π", -1: "−π"}
        ax.set_xticks([k * math.pi for k in ks], [names.get(k, f"{k}π".replace("-", "−")) for k in ks])


def _title(run: Run) -> str:
    """Return the title: the damping rate, if the model has a single constant one that positions determine."""
    damping = getattr(run.model, "damping", None)
    rate = getattr(damping, "rate", None)
    if run.model.inputs:
        return "States of the driven motion"
    if rate is None or run.model.s_enters_motion:
        return "States and flow of the learned model"
    unit = "" if run.data.time_unit in ("", "1") else f" per {run.data.time_unit}"
    return f"States decay along the learned flow: γ = {rate.item():.3g}{unit}"
