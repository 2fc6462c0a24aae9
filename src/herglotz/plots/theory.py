"""Figures of the theory: the identities of S^k of any L_d, over fans of solutions."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from herglotz.data.files import PathLike
from herglotz.data.units import common_unit
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.plots import FIGURES
from herglotz.plots.motion import momentum_unit
from herglotz.plots.parachute import physical_fall, plot_fall, plot_printed_map, printed_map
from herglotz.plots.style import (
    ACCENT,
    INK,
    MODEL,
    MUTED,
    UNSEEN,
    captions,
    label,
    new_figure,
    save_all,
    styled,
    with_unit,
)
from herglotz.stepping import State
from herglotz.theory import GeneratingFunction, RightHamiltonian, generating_functions, hamilton_jacobi_residual
from herglotz.verify.subject import Subject, named, subject

# S^k is drawn where the spread of ∂q_k/∂p̂0 is above this part of the fan's median. At a caustic the spread is 0, and
# S^k has no derivative.
MIN_SPREAD = 1e-3


def regular(S: GeneratingFunction) -> Tensor:
    """Return (F,) bool, where S^k exists: S^k is finite, and the solution is not at a caustic."""
    finite = torch.isfinite(S.S) & torch.isfinite(S.D2).all(-1) & torch.isfinite(S.p).all(-1)
    spread = torch.where(finite, S.spread, torch.zeros_like(S.spread))
    typical = spread[finite].median() if bool(finite.any()) else spread.sum()
    return finite & (spread > MIN_SPREAD * typical)


def spread_fan(source: Any, size: int, h: float | None = None) -> Subject:
    """Return solutions from `size` states of the data of a run; without a run, from drawn states."""
    known = subject(source, _typical_step(source) if h is None else h, size, 0)
    if known.L_d is None:
        raise InputError(f"{known.name} holds no L_d; the figures of S^k need one: give the run, or the L_d")
    return known


def point_fan(source: Any, size: int, h: float | None = None) -> Subject:
    """Return `size` solutions through one point (q̂0, ŝ0) with different p̂0 along one direction.

    The point is one of the states that `spread_fan` starts from.
    """
    known = spread_fan(source, 64, h)
    q, p, s = known.states
    row = int((q - q.median(0).values).abs().sum(-1).argmax()) if len(s) < 3 else len(s) // 3
    reach = (p - p.median(0).values).abs().quantile(0.9, dim=0)
    steps = torch.linspace(-1.0, 1.0, size, dtype=p.dtype, device=p.device)
    momenta = p.median(0).values + steps[:, None] * reach.clamp_min(1e-6)
    return replace(known, states=State(q[row].expand(size, -1).clone(), momenta, s[row].expand(size).clone()))


def solutions(fan: Subject, steps: int, start: State | None = None) -> list[GeneratingFunction]:
    """Return S^1, S^2, …, S^steps and their derivatives along every solution of the fan, or from other starts."""
    return generating_functions([fan.flow(1, k) for k in range(steps)], *(fan.states if start is None else start))


def _momentum_unit(fan: Subject) -> str:
    """The unit of momenta; "" where there is no run."""
    unit = "" if fan.run is None else momentum_unit(fan.run)
    return unit and f"{unit}, mass 1"


def _typical_step(source: Any) -> float | None:
    """A tenth of the typical time of a model; None for other sources, which have a step of their own."""
    if not isinstance(source, ContactLagrangian):
        return None
    return 0.1 * min(a / b for a, b in zip(source.config.scale, source.config.speed, strict=True))


# Steps k of every figure, and solutions of the fan through one point.
STEPS, SIZE = 8, 31
# The null experiment is drawn at the first, the middle and the last step.
NULL_STEPS = (1, 4, 8)
# Distances of p̂0 from the solution of the fan, in widths of the fan.
DISTANCES = torch.logspace(-5, -0.5, 10, dtype=torch.float64)
# Index of the distance through which the reference line of slope 2 is drawn.
ANCHOR = 7
# A difference of exactly 0 is drawn at this multiple of the machine epsilon: the axes are logarithmic.
ZERO_IN_EPSILONS = 1 / 200
# Label of points at which S^k does not exist.
NO_S = "(caustic, or failed step)"


def plot_momentum_vs_generating_function(source: Any, *, h: float | None = None) -> Figure:
    """Draw D2S^k(q_k) against the momentum p_k of the stepper, for k = 1…8, from states spread over the data.

    S^k is the action accumulated along the discrete solution, as a function of the end point. If D2S^k(q_k) = p_k to
    rounding, then S^k generates the stepper. Solutions with a failed step or at a caustic are left out.

    Parameters
    ----------
    source
        A run, a model alone (its states are drawn at random), a scene, an L_d with h, or a pair (L_d, states) with h.
    h
        Step; None: the typical model step of a run, a tenth of the typical time of a model.

    Raise InputError if no solution has an S^k: all failed, or all are at a caustic.
    """
    fan = spread_fan(source, 32, h)
    pairs, points, left_out = [], 0, 0
    for S in solutions(fan, STEPS):
        fine = regular(S)
        points, left_out = points + int(fine.sum()), left_out + int((~fine).sum())
        pairs.append(torch.stack([S.p[fine], S.D2[fine]]).flatten(1).double().cpu().numpy())
    everything = np.concatenate(pairs, 1)
    _check_any(points)
    worst = float(np.abs(everything[0] - everything[1]).max())
    floor = ZERO_IN_EPSILONS * torch.finfo(fan.states.q.dtype).eps
    missing = f", {left_out} left out {NO_S}" if left_out else ""
    with styled():
        figure = new_figure(9.2, 4.4, f"The action's derivative is the momentum, to {worst:.1e}")
        left, right = figure.subplots(1, 2, width_ratios=[1.0, 1.0])
        unit = _momentum_unit(fan)
        ends = [everything.min(), everything.max()]
        left.plot(ends, ends, color=MUTED, lw=0.9, zorder=1)
        left.plot(*everything, "o", ms=4, mfc="none", mec=MODEL, mew=0.9, zorder=2)
        captions(left, [(f"○ {points} end points{missing}", MODEL), ("─ y = x", "#666666")])
        left.set(xlabel=with_unit("$p_k$ from the stepper", unit), box_aspect=1)
        left.set(ylabel=with_unit(r"$D_2S^k(q_k)$ from the action", unit))
        for k, (p, dS) in enumerate(pairs, 1):
            right.plot(np.full(len(p), k), np.maximum(np.abs(p - dS), floor), "o", ms=3.5, color=MODEL, alpha=0.35)
        right.axhline(max(worst, floor), color=INK, lw=1.0, ls=(0, (4, 3)))
        label(right, STEPS, max(worst, floor), f"largest: {worst:.1e}", INK, ha="right", xytext=(8, 3))
        right.set(
            yscale="log", ylim=(floor / 3, max(1e3 * worst, 1e6 * floor)), xlabel="steps k", xticks=range(1, STEPS + 1)
        )
        captions(right, [(f"a difference of exactly 0 is drawn at {floor:.0e}", "#666666")])
        right.set(ylabel=with_unit(r"$|D_2S^k(q_k) - p_k|$", unit), box_aspect=1)
    return figure


def plot_hamilton_jacobi_residual(source: Any, *, h: float | None = None) -> Figure:
    """Draw the residual of the discrete Hamilton–Jacobi equation on the flow, and off the flow as the null experiment.

    Left: |S^{k+1}(q_{k+1}) − S^k(q_k) − dS^{k+1}·q_{k+1} + H⁺(q_k, dS^{k+1}, s_k)| over the sum of its terms' sizes,
    for a fan of solutions through one point. Right: the same with q_{k+1} of a neighbouring solution of the fan. Off
    the flow the equation is no identity (erratum E7), and the residual must grow with the square of the distance: a
    check whose residual stayed small off the flow would check nothing. Arguments and errors are those of
    `plot_momentum_vs_generating_function`.
    """
    fan = point_fan(source, SIZE, h)
    S = solutions(fan, STEPS + 1)
    rows = [_residual(fan.at(k + 1), S[k], S[k + 1], S[k + 1]) for k in range(STEPS)]
    table = torch.stack(rows).double().cpu().numpy()
    _check_any(np.isfinite(table).sum())
    distance, off_flow = _off_flow(fan, S)
    worst = float(np.nanmax(table))
    floor = ZERO_IN_EPSILONS * torch.finfo(fan.states.q.dtype).eps
    with styled():
        title = f"The action solves the discrete Hamilton–Jacobi equation: largest relative residual {worst:.1e}"
        figure = new_figure(10.2, 4.2, title)
        left, right = figure.subplots(1, 2, width_ratios=[1.15, 1.0])
        _draw_table(figure, left, fan, np.maximum(table, floor))
        unit = "" if fan.run is None else common_unit(fan.run.data.units)
        far = with_unit(r"distance of $q_{k+1}$ from the flow", unit)
        _draw_null(right, distance, off_flow, max(worst, floor), far)
    return figure


def _residual(now: Subject, S0: GeneratingFunction, S1: GeneratingFunction, near: GeneratingFunction) -> Tensor:
    """Return |residual| between S^k at S0 and S^{k+1} at S1 over the sum of its terms' sizes, (F,); NaN without S^k.

    H⁺ has several branches: Newton's iteration starts at the solution `near`.
    """
    assert now.L_d is not None
    H_plus = RightHamiltonian(now.L_d, near.q)(S0.q, S1.D2, S0.s, now.h)
    residual = hamilton_jacobi_residual(S1.S, S0.S, S1.D2, S1.q, H_plus).detach().abs()
    size = S1.S.abs() + S0.S.abs() + (S1.D2 * S1.q).sum(-1).abs() + H_plus.detach().abs()
    return torch.where(regular(S0) & regular(S1), residual / size, torch.nan)


def _off_flow(fan: Subject, S: list[GeneratingFunction]) -> tuple[np.ndarray, np.ndarray]:
    """Return median distances and residuals, (K, D), with q_{k+1} of another solution of the fan."""
    q, p, s = fan.states
    count, width = len(DISTANCES), p[-1] - p[0]
    momenta = p + DISTANCES.to(p)[:, None, None] * width
    moved = State(q.repeat(count, 1), momenta.flatten(0, 1), s.repeat(count))
    distances, residuals = [], []
    off = solutions(fan, max(NULL_STEPS) + 1, moved)
    for k in NULL_STEPS:
        S0, S1 = (S[j].map(lambda x: torch.cat([x] * count)) for j in (k - 1, k))
        distances.append((off[k].q - S1.q).norm(dim=-1).reshape(count, -1).nanmedian(1).values)
        residuals.append(_residual(fan.at(k), S0, off[k], S1).reshape(count, -1).nanmedian(1).values)
    return torch.stack(distances).double().cpu().numpy(), torch.stack(residuals).double().cpu().numpy()


def _draw_table(figure: Figure, ax: Axes, fan: Subject, table: np.ndarray) -> None:
    momenta = fan.states.p[:, 0].double().cpu().numpy()
    half = 0.5 * (momenta[1] - momenta[0])
    extent = (momenta[0] - half, momenta[-1] + half, 0.5, STEPS + 0.5)
    low = math.floor(np.log10(ZERO_IN_EPSILONS * torch.finfo(fan.states.q.dtype).eps))
    image = ax.imshow(
        np.log10(table), origin="lower", aspect="auto", extent=extent, cmap="cividis",
        vmin=low, vmax=-1, interpolation="nearest",
    )  # fmt: skip
    ax.set_facecolor("#DDDDDD")
    bar = figure.colorbar(image, ax=ax, ticks=np.linspace(low, -1, 5).round())
    bar.set_label("log₁₀ relative residual", fontsize=9)
    missing = "" if np.isfinite(table).all() else f", grey: left out {NO_S}"
    name = r"initial momentum $\hat p_0$" + (", first coordinate" if fan.states.p.shape[1] > 1 else "")
    ax.set(xlabel=with_unit(name, _momentum_unit(fan)))
    ax.set(ylabel="steps k", yticks=range(1, STEPS + 1), title="on the flow" + missing)
    ax.spines[:].set_visible(False)


def _draw_null(ax: Axes, distance: np.ndarray, off_flow: np.ndarray, on_flow: float, xlabel: str) -> None:
    names: list[tuple[str, str]] = []
    for d, r, color, k in zip(distance, off_flow, (MODEL, UNSEEN, ACCENT), NULL_STEPS, strict=True):
        fine = np.isfinite(r) & (r > 0) & (d > 0)
        ax.plot(d[fine], r[fine], "o-", ms=3, color=color)
        names.append((f"● k = {k}", color))
    ax.set(xscale="log", yscale="log", xlabel=xlabel, ylabel="relative residual, median", title="off the flow (null)")
    ax.axhline(on_flow, color=INK, lw=1.0, ls=(0, (4, 3)))
    span = np.array([np.nanmin(distance), np.nanmax(distance)])
    square = off_flow[0, ANCHOR] * (span / distance[0, ANCHOR]) ** 2
    ax.plot(span, 6 * square, color=MUTED, lw=1.0, ls=":")
    ax.set_ylim(bottom=on_flow / 30, top=1e5 * np.nanmax(square))
    captions(ax, names, row=1)
    label(ax, span[1], on_flow, f"largest on the flow: {on_flow:.1e}", ha="right")
    slope = _slope(distance[0], off_flow[0], 30 * on_flow)
    captions(
        ax,
        [
            (f"grows like distance^{slope:.2f}" if math.isfinite(slope) else "growth not measurable", MODEL),
            ("dotted: the square, as it must", "#666666"),
        ],
    )


def _slope(d: np.ndarray, r: np.ndarray, noise: float) -> float:
    """Return the slope of log r over log d between rounding and saturation."""
    fine = np.isfinite(r) & (r > noise) & (r < 1e-2) & (d > 0)
    return float(np.polyfit(np.log(d[fine]), np.log(r[fine]), 1)[0]) if fine.sum() > 1 else float("nan")


def _check_any(count: int) -> None:
    if not count:
        raise InputError("no solution has an S^k to draw: all failed, or all are at a caustic; give a smaller h")


# Figures of identities of S^k that hold to rounding. A model with forces has no S^k.
IDENTITIES = {"momentum_vs_dS": plot_momentum_vs_generating_function, "hj_residual": plot_hamilton_jacobi_residual}
NAMED = {**FIGURES, **IDENTITIES}


def save_theory_figures(source: Any, folder: PathLike, *, h: float | None = None, form: str = "png") -> list[Path]:
    """Draw D2S^k = p_k and the discrete Hamilton–Jacobi equation of a source into `folder`, made if it is missing.

    Source: section 1 and errata E5 to E7 of `docs/mathematics.md`.

    Parameters
    ----------
    source
        Anything that `verify` takes and that has an L_d: a scene or its name, a run or its folder, an L_d with h, a
        pair (L_d, states) with h. The scene "parachute" adds the paper's two figures: the printed map, and a fall.
    folder
        Where the files go.
    h
        Step, in the source's unit of time; default that of the source.
    form
        png, svg or pdf.

    Returns
    -------
    list of Path
        What was written, one file a figure.

    Raises
    ------
    InputError
        If the source is none of these or has forces, whose map has no S^k; or the folder cannot be made.
    """
    source = named(source)
    L_d = getattr(source, "model", getattr(source, "L_d", source))
    if getattr(L_d, "friction", None) is not None or getattr(source, "external", None) is not None:
        raise InputError("with friction or other forces a step is no contact map: there is no S^k to draw")
    drawn = {name: plot(source, h=h) for name, plot in IDENTITIES.items()}
    if getattr(source, "name", "") == "parachute":
        drawn["parachute_map"] = plot_printed_map(printed_map())
        drawn["parachute_fall"] = plot_fall(physical_fall())
    return save_all(drawn, folder, form)
