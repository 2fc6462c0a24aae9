"""The functions that a model has learned, along one coordinate or speed, with the bands of their posterior.

Positions identify a model only up to a gauge (trap 3 of `docs/mathematics.md`). Functions are given in this gauge:

* the first entry of the mass has the mean 1 over the data, so that forces are accelerations of the first coordinate;
* the potential V has the mean 0 over the recorded range;
* friction is 0 at rest: a constant force, which waves of a speed can contain, is a tilt of V.

The variance of a function f in this gauge is std² = ∇f · Σ ∇f, with the covariance Σ of `function_posterior`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from herglotz.data.splits import leading
from herglotz.errors import InputError, refuse
from herglotz.models import ContactLagrangian, refuse_own
from herglotz.models.terms import LinearDamping
from herglotz.stepping.explicit import FieldOf
from herglotz.threads import one_thread
from herglotz.training.function_posterior import SAMPLES, by_numbers, function_posterior, mass_at
from herglotz.training.run import Run
from herglotz.training.uncertainty import Laplace

# Relative variation below which a function is constant: rounding of float32.
MAX_VARIATION_OF_CONSTANT = 1e-6
# Points x (K,), and the ends of the recorded range.
Line = tuple[Tensor, float, float]
# Kind, coordinates and line of a function.
Part = tuple[str, tuple[int, ...], Line]


@dataclass(frozen=True)
class LearnedFunction:
    """A function of a model along one coordinate or speed, with the other coordinates at their medians.

    Its posterior at x is 𝒩(mean, std²): section 7 of `docs/trajectory.md`.

    Parameters
    ----------
    kind
        "potential" V, "force" −∂V/∂q_i, "friction" f_i(v_i), "damping" −f_i/v_i by position at the RMS speed, or
        "mass" m_jk.
    of
        (i,), the coordinate from 0. For a mass (j, k, i), the entry m_jk and the coordinate i that m_jk depends on.
    x
        (K,) positions or speeds, in the data's units; −π to π for an angle whose range exceeds one turn.
    value
        (K,) of the model, in units where the mass of the first coordinate is 1.
    low, high
        The range of x in the training data, in the data's units.
    mean, std
        (K,) of the posterior, in the units of `value`; None without a posterior. The mean differs from `value` if the
        data need more than the model has, or if the model's steps are not short. `std` is infinite beyond the recorded
        range, and everywhere if left-out blocks of time cannot be predicted.
    """

    kind: str
    of: tuple[int, ...]
    x: Tensor  # (K,)
    value: Tensor  # (K,)
    low: float
    high: float
    mean: Tensor | None = None  # (K,)
    std: Tensor | None = None  # (K,)

    def interval(self, level: float = 0.9) -> tuple[Tensor, Tensor]:
        """Lower and upper ends of the central interval of the posterior, (K,) each; `level` is its probability."""
        refuse({f"level must be between 0 and 1, got {level:g}; 0.9 is usual": not 0 < level < 1})
        if self.mean is None or self.std is None:
            raise InputError("a function without a posterior has no band; give one: learned_functions(laplace(run))")
        width = NormalDist().inv_cdf(0.5 + level / 2) * self.std
        return self.mean - width, self.mean + width


@one_thread()
def learned_functions(of: Run | Laplace, *, points: int = 101, beyond: float = 0.0) -> list[LearnedFunction]:
    """The functions that a run has learned, along each coordinate; with bands if its posterior is given.

    Each coordinate has a potential and a force, and a friction if the model has friction. Damping and the entries of
    the mass are listed if they depend on the position. The gauge is described in section 7 of `docs/trajectory.md`.

    Parameters
    ----------
    of
        A fitted run, or its posterior, `laplace(run)`.
    points
        K, number of points, evenly spaced over the recorded range.
    beyond
        Share of the recorded range by which x continues on both sides, where the model extrapolates; dimensionless.

    Returns
    -------
    list of LearnedFunction
        Potential, force, friction, damping and mass of the first coordinate, and so on.

    Raises
    ------
    InputError
        If the model is the user's own module, there are fewer than two points, or `beyond` is negative.

    Examples
    --------
    >>> potential, force, *others = learned_functions(laplace(run))
    >>> low, high = force.interval(0.9)
    """
    run = of.run if isinstance(of, Laplace) else of
    refuse_own(run.model, "its functions", "evaluate the module itself")
    refuse({f"points must be 2 or more, got {points}": points < 2, f"beyond must be >= 0, got {beyond:g}": beyond < 0})
    lines = _Lines(run, points, beyond)
    with torch.no_grad():
        value = lines.values(run.model).split(points)
        if not isinstance(of, Laplace):
            mean = std = [None] * len(value)
        else:
            posterior = function_posterior(of)
            std = posterior.std(by_numbers(posterior.model, lines.values, posterior.theta)).split(points)
            mean = lines.values(posterior.model).split(points)
    every = zip(lines.parts, value, mean, std, strict=True)
    return [
        LearnedFunction(kind, i, x, y, low, high, m, _inside(s, x, low, high))
        for (kind, i, (x, low, high)), y, m, s in every
    ]


class _Lines:
    """The lines along which the functions of a run are evaluated."""

    @torch.no_grad()
    def __init__(self, run: Run, points: int, beyond: float):
        self.h, q, steps = run.h, run.states.q.detach(), run.data.steps()
        trained = leading(run.data.lengths, run.train_lengths).to(q.device)
        v = (q[steps.index + 1] - q[steps.index]) / steps.h[:, None]
        q, v = q[trained & q.isfinite().all(-1)], v[trained[steps.index + 1] & v.isfinite().all(-1)]
        self.some = q[:: -(-len(q) // SAMPLES)]
        self.middle, self.speed = q.median(0).values, v.square().mean(0).sqrt()
        self.parts = [
            part
            for i, turns in enumerate(run.data.angles)
            for part in self._of(run.model, i, _range(q[:, i], points, beyond, turns), _range(v[:, i], points, beyond))
        ]

    def _of(self, model: ContactLagrangian, i: int, at: Line, speeds: Line) -> list[Part]:
        """Kinds and lines of the functions of coordinate i: positions `at`, and `speeds`."""
        found: list[Part] = [("potential", (i,), at), ("force", (i,), at)]
        friction = isinstance(model.damping, LinearDamping)
        found += [("friction", (i,), speeds)] if friction else []
        found += [("damping", (i,), at)] if friction and _varies(self._damping(model, i, at[0])) else []
        m = mass_at(model, self._line(i, at[0]), self.h)
        pairs = ((j, k) for j in range(len(m)) for k in range(j, len(m)))
        return [*found, *(("mass", (j, k, i), at) for j, k in pairs if _varies(m[j, k], m))]

    def values(self, model: ContactLagrangian) -> Tensor:
        """All functions of a model in the gauge of this module, concatenated, float64."""
        unit = mass_at(model, self.some, self.h)[0, 0].double().cpu().mean()
        return torch.cat([self._value(model, kind, of, *line) / unit for kind, of, line in self.parts])

    def _value(
        self, model: ContactLagrangian, kind: str, of: tuple[int, ...], x: Tensor, low: float, high: float
    ) -> Tensor:
        """A function on its line before the division by the mean mass, (K,)."""
        i = of[-1]
        if kind == "friction":
            v = self.middle.new_zeros(len(x), len(self.middle))
            v[:, i] = x.to(v)
            q = self.middle.expand_as(v)
            return (self._friction(model, q, v) - self._friction(model, q, 0 * v))[:, i].double().cpu()
        if kind == "damping":
            return self._damping(model, i, x)
        q = self._line(i, x)
        if kind == "mass":
            return mass_at(model, q, self.h)[of[0], of[1]].double().cpu()
        field, rest = FieldOf(model.potential)(q), self._friction(model, q, 0 * q)[:, i].double().cpu()
        if kind == "force":
            return rest - field.slope[:, i].double().cpu()
        V = field.V.double().cpu() - torch.cat([rest[:1] * 0, torch.cumulative_trapezoid(rest, x)])
        return V - V[(x >= low) & (x <= high)].mean()

    def _damping(self, model: ContactLagrangian, i: int, x: Tensor) -> Tensor:
        """−f_i/v_i at the RMS speed, the mean of both directions, (K,)."""
        q = self._line(i, x)
        v = torch.zeros_like(q)
        v[:, i] = self.speed[i]
        return (self._friction(model, q, -v) - self._friction(model, q, v))[:, i].double().cpu() / float(
            2 * self.speed[i]
        )

    def _line(self, i: int, x: Tensor) -> Tensor:
        """Positions (K, n): coordinate i along x, the others at their medians."""
        q = self.middle.expand(len(x), -1).clone()
        q[:, i] = x.to(q)
        return q

    def _friction(self, model: ContactLagrangian, q: Tensor, v: Tensor) -> Tensor:
        """Dissipative force −γ m v of the contact term at s = 0 plus the forces beside L without inputs, (K, n)."""
        if not isinstance(model.damping, LinearDamping):
            return 0.0 * v
        h, rate = torch.full_like(q[:, 0], self.h), model.damping.rate
        force = -rate * (mass_at(model, q, self.h).movedim(-1, 0) @ v[..., None])[..., 0]
        parts = model.forces(q - h[:, None] * v / 2, q + h[:, None] * v / 2, torch.zeros_like(h), h)
        if parts is None:
            return force
        c = 1.0 if model.action is not None else (-rate * h).exp()[:, None]
        return force + (parts[0] / c + parts[1]) / h[:, None]


def _range(values: Tensor, points: int, beyond: float, turns: bool = False) -> Line:
    """Evenly spaced points over the range of the values and beyond, and the range.

    For an angle (`turns`) whose range exceeds one turn, one turn: functions of an angle are periodic, and the points
    would be too few for each of many turns.
    """
    low, high = float(values.min()), float(values.max())
    if turns and high - low > 2 * math.pi:
        return torch.linspace(-math.pi, math.pi, points, dtype=torch.float64), -math.pi, math.pi
    room = beyond * ((high - low) or 1.0)
    return torch.linspace(low - room, high + room, points, dtype=torch.float64), low, high


def _inside(std: Tensor | None, x: Tensor, low: float, high: float) -> Tensor | None:
    """The deviations, infinite beyond the recorded range: waves vanish there by their form, not by the data."""
    return None if std is None else torch.where((x >= low) & (x <= high), std, torch.inf)


def _varies(values: Tensor, among: Tensor | None = None) -> bool:
    """True if a function varies by more than rounding, relative to the largest of the values `among`."""
    size = (values if among is None else among).abs().amax()
    return bool(values.amax() - values.amin() > MAX_VARIATION_OF_CONSTANT * size)
