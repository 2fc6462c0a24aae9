"""What the model has learned: potential, force, friction and mass along each coordinate, with the data's support."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from herglotz.models import refuse_own
from herglotz.models.phase import Phase
from herglotz.models.terms import LinearDamping
from herglotz.plots.motion import momentum_unit, trained_mask
from herglotz.plots.style import MODEL, MUTED, SERIES, SUPPORT, captions, new_figure, position_axis, styled, with_unit
from herglotz.stepping.field import FieldOf

if TYPE_CHECKING:
    from herglotz.training import Laplace, Run

MOST_COLUMNS, POINTS = 3, 161
BEYOND = 0.25  # of the data's range, drawn on both sides of it
STEP = 1e-4  # of a difference with respect to parameters, which are of size 1
CONSTANT = 1e-6  # of the largest mass: entries that vary by less are rounding of float32
Curves = list[Tensor]  # the curve and, with a posterior, its standard deviation, (POINTS,) each


def plot_learned(run: Run, posterior: Laplace | None = None) -> Figure:
    """Draw V(q_i) and the force −∂V/∂q_i along each coordinate, the others at their median; and friction, if any.

    Friction is the force against the velocity at rest of all else: −γ m v of the contact term, and named friction.
    Where the mass depends on position, its entries m_jk that do are drawn along each coordinate, too. The first mass
    is 1, so that forces are accelerations of the first coordinate. The range of the training data is shaded: beyond
    it the model extrapolates.

    Parameters
    ----------
    run
        A fitted run.
    posterior
        Adds bands of two standard deviations.
    """
    refuse_own(run.model, "the figure", "plot what the module has learned from the module")
    columns = min(run.data.dof, MOST_COLUMNS)
    rubs = run.model.friction is not None or isinstance(run.model.damping, LinearDamping)
    entries = _moving_masses(run)
    rows = 2 + rubs + bool(entries)
    momentum = momentum_unit(run)
    force = momentum + "²" if momentum and run.data.time_unit not in ("", "1") else ""  # rad/s, rad/s²
    length = "" if run.data.units[0] == "1" else run.data.units[0]
    energy = force.replace(length, f"{length}²", 1) if length else force  # rad²/s²: the first mass is 1
    steps, q = run.data.steps(), run.data.unwrapped().q
    speeds = (q[steps.index + 1] - q[steps.index]) / steps.h[:, None]
    with styled():
        figure = new_figure(1.2 + 3.9 * columns, 2.3 * rows + 0.5, "What the model has learned, mass 1")
        axes = figure.subplots(rows, columns, squeeze=False)
        for i in range(columns):
            x, low, high = _range(run.states.q[trained_mask(run), i])
            _panel(axes[0, i], x, _curves(posterior, _potential(run, i, x)), (low, high))
            axes[0, i].set_ylabel(with_unit("potential V", energy))
            _panel(axes[1, i], x, _curves(posterior, _force(run, i, x)), (low, high))
            axes[1, i].set_ylabel(with_unit("force −∂V/∂q", force))
            if rubs:
                v, low, high = _range(speeds[:, i])
                _panel(axes[2, i], v, _curves(posterior, _friction(run, i, v)), (low, high))
                axes[2, i].set(xlabel=with_unit(f"velocity of {run.data.names[i]}", momentum))
                at = " at s = 0" if run.model.config.dissipation else ""
                axes[2, i].set_ylabel(with_unit(f"friction{at}", force))
            for (j, k), color in zip(entries, SERIES, strict=False):
                _panel(axes[-1, i], x, _curves(posterior, _mass(run, i, x, (j, k))), (low, high), color)
                axes[-1, i].set_ylabel("mass")
            for ax in (*axes[:2, i], *axes[2 + rubs :, i]):
                position_axis(ax, run.data, i)
        band = [] if posterior is None else [("band: ±2 standard deviations", MODEL)]
        captions(axes[0, 0], [("shaded: where the data are", "#666666"), *band])
        axes[0, 0].margins(y=0.3)
        if entries:
            captions(axes[-1, 0], [(f"m{j + 1}{k + 1}", c) for (j, k), c in zip(entries, SERIES, strict=False)])
            axes[-1, 0].margins(y=0.3)
    return figure


def _range(values: Tensor) -> tuple[Tensor, float, float]:
    values = values[torch.isfinite(values)].double()
    low, high = float(values.min()), float(values.max())
    room = BEYOND * ((high - low) or 1.0)
    return torch.linspace(low - room, high + room, POINTS, dtype=torch.float64), low, high


def _line(run: Run, i: int, x: Tensor) -> Tensor:
    """Positions (POINTS, n): coordinate i along x, the others at the median of the data."""
    like = run.states.q
    q = like[torch.isfinite(like).all(-1)].median(0).values.detach().expand(len(x), -1).clone()
    q[:, i] = x.to(q)
    return q


def _potential(run: Run, i: int, x: Tensor) -> Callable[[], Tensor]:
    q = _line(run, i, x)

    def V() -> Tensor:
        value = FieldOf(run.model.potential)(q).V
        return value - value.min()

    return V


def _force(run: Run, i: int, x: Tensor) -> Callable[[], Tensor]:
    q = _line(run, i, x)
    return lambda: -FieldOf(run.model.potential)(q).slope[:, i]


def _friction(run: Run, i: int, v: Tensor) -> Callable[[], Tensor]:
    """The force against the velocity of coordinate i: −γ m v of the contact term, and that of the friction."""
    friction, damping = run.model.friction, run.model.damping
    m = _masses(run, _line(run, i, run.states.q[:1, i]))[..., 0]
    speeds = torch.zeros(len(v), run.data.dof, dtype=run.states.q.dtype)
    speeds[:, i] = v.to(speeds)

    def f() -> Tensor:
        force = -damping.rate * speeds @ m if isinstance(damping, LinearDamping) else torch.zeros_like(speeds)
        if friction is not None:
            held = friction.grip(speeds)[0] * speeds.sign() if friction.sticking else 0.0
            force = force + friction.force(speeds, None).value - held
        return force[:, i]

    return f


def _mass(run: Run, i: int, x: Tensor, entry: tuple[int, int]) -> Callable[[], Tensor]:
    q = _line(run, i, x)
    return lambda: _masses(run, q)[entry]


def _masses(run: Run, q: Tensor) -> Tensor:
    """m(q) = −h ∂²K/∂q₀∂q₁ at rest, (n, n, POINTS), q (POINTS, n)."""
    n, h = run.data.dof, torch.full(q.shape[:1], run.h, dtype=q.dtype)
    K = run.model.terms(Phase(q, q, h, 2, run.model.config)).K
    return q.new_zeros(n, n, len(q)) if K is None else -run.h * K.hessian()[:n, n:].movedim(-1, 2)


@torch.no_grad()
def _moving_masses(run: Run) -> list[tuple[int, int]]:
    """The entries of the mass, on and above the diagonal, that depend on position where the data are."""
    q = run.states.q[torch.isfinite(run.states.q).all(-1)]
    m = _masses(run, q)
    spread = m.amax(-1) - m.amin(-1) > CONSTANT * m.abs().amax()
    return [(j, k) for j in range(len(m)) for k in range(j, len(m)) if bool(spread[j, k])]


def _curves(posterior: Laplace | None, curve: Callable[[], Tensor]) -> Curves:
    """The curve at the fitted parameters θ, and its standard deviation to first order, sqrt(diag(J Σ Jᵀ)).

    J along each principal axis of the covariance Σ of θ is a central difference; θ is put back.
    """
    with torch.no_grad():
        found = [curve().double()]
        if posterior is None:
            return found
        theta, parameters = posterior.theta, posterior.problem.parameters
        values, vectors = torch.linalg.eigh(posterior.covariance[: len(theta), : len(theta)])
        variance = torch.zeros_like(found[0])
        try:
            for value, axis in zip(values.clamp_min(0).tolist(), vectors.T, strict=True):
                ends = []
                for side in (STEP, -STEP):
                    parameters.set(theta + (side * axis).to(theta))
                    ends.append(curve().double())
                variance += value * ((ends[0] - ends[1]) / (2 * STEP)).square()
        finally:
            parameters.set(theta)
    return [*found, variance.sqrt()]


def _panel(ax: Axes, x: Tensor, curves: Curves, support: tuple[float, float], color: str = MODEL) -> None:
    ax.axvspan(*support, color=SUPPORT, lw=0, zorder=0)
    ax.axhline(0.0, color=MUTED, lw=0.6, zorder=1)
    if len(curves) > 1:
        spread = 2 * curves[1]
        ax.fill_between(x, curves[0] - spread, curves[0] + spread, color=color, alpha=0.25, lw=0, zorder=2)
    ax.plot(x, curves[0], color=color, zorder=3)
    ax.set_xlim(float(x[0]), float(x[-1]))
