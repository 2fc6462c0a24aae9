"""Two figures of the parachute: the map that the paper prints, and a fall (erratum E9).

The paper iterates the printed map (H⁺ without the near-identity part, λ = −0.01) from (q, p, s) = (100, 1, 1). The
fall is the parachute q̈ = λq̇² − g, λ = +0.01, from the same start, with its exact discrete Lagrangian.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from herglotz.data.units import size
from herglotz.plots.style import ACCENT, INK, MODEL, MUTED, UNSEEN, captions, label, new_figure, styled
from herglotz.scenes import scene
from herglotz.scenes.parachute import MAP_START, PrintedParachute
from herglotz.stepping import State, Stepper
from herglotz.theory import RightHamiltonian, generating_functions, hamilton_jacobi_residual

# The axes are logarithmic: a difference of exactly 0 is drawn here.
FLOOR = 1e-18
# Points of the printed map in the figures: the next is ten times larger, and the one after that 1e22.
SHOWN = 6
# Gravity [m/s²], drag [1/m] and step [s] of the fall.
G, LAM, H = 10.0, 0.01, 0.2


@dataclass(frozen=True)
class PrintedOrbit:
    """The printed map's first points.

    Arrays over k = 0…K, slopes dS = D2S^k(q_k) over k = 1…K. The names with `_squared` belong to the map with −2λ²s_k²
    in the line of s. `last` is the last k that is finite in float64.
    """

    q: np.ndarray
    p: np.ndarray
    dS: np.ndarray
    p_squared: np.ndarray
    dS_squared: np.ndarray
    last: int


@dataclass(frozen=True)
class Fall:
    """A fall in closed form, from t = 0 to the last step before the ground.

    Slopes dS = D2S^k(q_k) are those from k = 1 on. `residual` is that of the discrete Hamilton–Jacobi equation between
    k and k + 1, relative to the sum of its terms' sizes. Velocities are negative downwards.
    """

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    p: np.ndarray
    dS: np.ndarray
    residual: np.ndarray
    landing_time: float
    landing_speed: float
    terminal_speed: float


def plot_printed_map(orbit: PrintedOrbit) -> Figure:
    """Draw the paper's two figures: q_k and p_k of the printed map, and D2S^k(q_k) beside p_k.

    The second panel has D2S^k(q_k) twice: of the map as printed, and with the square that is missing in its line of s
    (erratum E9).
    """
    k = np.arange(len(orbit.q))
    with styled():
        figure = new_figure(9.2, 4.2, "The printed map is no fall, and its $D_2S^k$ is not $p_k$")
        left, right = figure.subplots(1, 2)
        left.axhline(0.0, color=MUTED, lw=0.8, zorder=1)
        left.plot(k, orbit.q, "o-", ms=4, color=UNSEEN, zorder=3)
        left.plot(k, orbit.p, "s-", ms=4, color=MODEL, zorder=2)
        label(left, k[-1], orbit.q[-1], "$q_k$", UNSEEN, xytext=(6, -4))
        label(left, k[-1], orbit.p[-1], "$p_k$", MODEL, xytext=(6, -4))
        captions(left, [(f"k = {orbit.last} is the last finite point in float64", INK)], "lower left")
        left.set(xlabel="k (there is no h)", ylabel="as printed, without units", title="λ = −0.01, from (100, 1, 1)")
        left.set_xlim(-0.3, k[-1] + 0.7)
        right.axhline(0.0, color=MUTED, lw=0.8, zorder=1)
        right.plot(k, orbit.p, "s-", ms=4, color=MODEL, zorder=2)
        right.plot(k[1:], orbit.dS, "o", ms=8, mfc="none", mec=UNSEEN, mew=1.3, zorder=4)
        right.plot(k, orbit.p_squared, "-", color=ACCENT, lw=1.0, zorder=2)
        right.plot(k[1:], orbit.dS_squared, "D", ms=7, mfc="none", mec=ACCENT, mew=1.1, zorder=3)
        captions(right, [("■ $p_k$ as printed", MODEL), (r"○ its $D_2S^k(q_k)$", UNSEEN)], "lower left")
        captions(right, [(r"◇ $D_2S^k(q_k)$ on $p_k$ with $s_k^2$", ACCENT)], "upper right")
        low, high = right.get_ylim()
        right.set(xlabel="k", title="the paper's check, both ways", xticks=k)
        right.set_ylim(low - 0.12 * (high - low), high + 0.1 * (high - low))
        left.set_xticks(k)
    return figure


def plot_fall(fall: Fall) -> Figure:
    """Draw the fall with λ = +0.01: height and velocity until the ground, and D2S^k(q_k) beside p_k."""
    with styled():
        title = f"A parachute lands after {size(fall.landing_time, 's')} at {size(-fall.landing_speed, 'm/s')}"
        figure = new_figure(9.2, 5.0, title)
        grid = figure.add_gridspec(2, 2, height_ratios=[1.6, 1.0])
        _draw_height(figure.add_subplot(grid[0, 0]), fall)
        _draw_velocity(figure.add_subplot(grid[1, 0]), fall)
        _draw_momentum(figure.add_subplot(grid[0, 1]), fall)
        _draw_differences(figure.add_subplot(grid[1, 1]), fall)
    return figure


def _draw_height(ax: Axes, fall: Fall) -> None:
    t = np.append(fall.t, fall.landing_time)
    ax.plot(t, np.append(fall.q, 0.0), color=UNSEEN)
    ax.axhline(0.0, color=MUTED, lw=0.8)
    ax.plot(fall.landing_time, 0.0, "o", color=INK, ms=5, clip_on=False, zorder=4)
    label(ax, fall.landing_time, 0.0, f"{fall.landing_time:.6f} s", ha="right", xytext=(-34, 3))
    ax.set(ylabel="height q (m)", xlim=(0.0, 1.02 * fall.landing_time), title="fall with λ = +0.01 1/m")
    ax.tick_params(labelbottom=False)


def _draw_velocity(ax: Axes, fall: Fall) -> None:
    ax.plot(np.append(fall.t, fall.landing_time), np.append(fall.v, fall.landing_speed), color=MODEL)
    ax.axhline(fall.terminal_speed, color=MUTED, lw=1.0, ls=(0, (4, 3)))
    label(ax, 0.0, fall.terminal_speed, f"terminal −{-fall.terminal_speed:.1f} m/s", "#666666", xytext=(4, 3))
    ax.plot(fall.landing_time, fall.landing_speed, "o", color=INK, ms=5, zorder=4)
    ax.set(xlabel="time (s)", ylabel="velocity (m/s)", xlim=(0.0, 1.02 * fall.landing_time))
    ax.set_ylim(1.1 * fall.terminal_speed, 3.0)


def _draw_momentum(ax: Axes, fall: Fall) -> None:
    ax.plot(fall.t, fall.p, color=MODEL)
    ax.plot(fall.t[1:], fall.dS, "o", ms=4.5, mfc="none", mec=UNSEEN, mew=0.9)
    captions(ax, [("━ $p_k$ of the stepper", MODEL), (r"○ $D_2S^k(q_k)$", UNSEEN)], "upper right")
    ax.set(ylabel="momentum (kg m/s)", xlim=(0.0, 1.02 * fall.landing_time), title="the action's derivative")
    ax.tick_params(labelbottom=False)


def _draw_differences(ax: Axes, fall: Fall) -> None:
    difference = np.abs(fall.dS - fall.p[1:]) / np.abs(fall.p[1:]).max()
    ax.plot(fall.t[1:], np.maximum(difference, FLOOR), "o", ms=3, color=UNSEEN)
    ax.plot(fall.t[2:], np.maximum(fall.residual, FLOOR), "x", ms=3.5, color=ACCENT)
    ax.set(yscale="log", ylim=(FLOOR / 3, 1e-11), xlabel="time (s)", ylabel="relative")
    ax.set_xlim(0.0, 1.02 * fall.landing_time)
    ax.set_title(f"exact zeros are drawn at {FLOOR:.0e}", fontsize=8.5, loc="right")
    captions(ax, [(r"● $|D_2S^k - p_k|$", UNSEEN), ("× Hamilton–Jacobi residual", ACCENT)])


def start() -> State:
    """Return the start of both motions, (100, 1, 1)."""
    q, p, s = (torch.tensor(x, dtype=torch.float64) for x in MAP_START)
    return State(q[None], p[None], s)


def printed_map() -> PrintedOrbit:
    """Return figure data of the orbit, as printed and with s², with D2S^k of both."""
    found = []
    for step in (PrintedParachute(), PrintedParachute(squared=True)):
        (q, p, _), last = step.orbit(*start(), steps=SHOWN + 6)
        dS = np.array([float(S.D2) for S in generating_functions([step] * SHOWN, *start())])
        found.append((q[: SHOWN + 1, 0].numpy(), p[: SHOWN + 1, 0].numpy(), dS, last))
    (q, p, dS, last), (_, p_squared, dS_squared, _) = found
    return PrintedOrbit(q, p, dS, p_squared, dS_squared, last)


def landing(q0: float, v0: float) -> tuple[float, float]:
    """Return time and velocity at q = 0, in closed form.

    cosh ωt − a sinh ωt = e^{λq0} with ω = √(λg), a = λv0/ω, and v² = g/λ − (g/λ − v0²) e^{−2λq0}.
    """
    omega = math.sqrt(LAM * G)
    a, K = LAM * v0 / omega, math.exp(LAM * q0)
    time = math.log((K + math.sqrt(K * K - (1 - a * a))) / (1 - a)) / omega
    return time, -math.sqrt(G / LAM - (G / LAM - v0 * v0) * math.exp(-2 * LAM * q0))


def physical_fall() -> Fall:
    """Return figure data of the fall, the discrete Hamilton–Jacobi equation evaluated between k and k + 1."""
    fall, x = scene("parachute", g=G, lam=LAM), start()
    v0 = float(fall.velocity(*x))
    time, speed = landing(float(x.q), v0)
    steps = int(time / H)
    stepper = Stepper(fall.L_d)
    solution = stepper.rollout(*x, h=H, steps=steps)
    S = generating_functions([lambda *state: stepper.step(State(*state), H).state] * steps, *x)
    residuals = []
    for S0, S1 in pairwise(S):
        H_plus = RightHamiltonian(fall.L_d, S1.q)(S0.q, S1.D2, S0.s, H).detach()
        residual = hamilton_jacobi_residual(S1.s, S0.s, S1.D2, S1.q, H_plus)
        residuals.append(float(residual.abs() / (S1.s.abs() + S0.s.abs() + H_plus.abs())))
    dS = torch.stack([x.D2[0] for x in S])
    v = fall.velocity(solution.q, solution.p, solution.s)[:, 0]
    t = H * np.arange(steps + 1)
    q, v, p, dS = (x.numpy() for x in (solution.q[:, 0], v, solution.p[:, 0], dS))
    return Fall(t, q, v, p, dS, np.array(residuals), time, speed, -math.sqrt(G / LAM))
