"""The baseline: sizes of the data, a typical step, and starting values by linear least squares."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.trajectories import GAP
from herglotz.data.windows import Triples
from herglotz.errors import InputError
from herglotz.least_squares import least_squares
from herglotz.models.translations import projection
from herglotz.training.problems.robust import robust_fit, scale_of

# A step longer than the typical one by up to this factor takes no additional model step.
JITTER = 1.05
# Outliers pull least squares if their misfit of the bulk exceeds that of Student's t by this ratio.
PULLED = 3.0
# Share of the RMS acceleration. A smaller misfit of the bulk means rest or exact data.
NEGLIGIBLE = 1e-3
# Residual of the acceleration, in robust standard deviations, that no smooth motion reaches.
GROSS = 30.0


@dataclass(frozen=True)
class Baseline:
    """Sizes of the data and starting values, as plain numbers for `ModelConfig`.

    `scale` and `speed` are the largest |q| and |q̇|, `low` and `high` the range of q. `max_step` is the longest recorded
    step that is no gap, `model_step` the longest model step along a trajectory. `input_map` has accelerations per unit
    of each input, row by row; `start` known values of parameters, `spreads` prior deviations of terms, both by name.
    """

    angles: tuple[bool, ...]
    scale: tuple[float, ...]
    speed: tuple[float, ...]
    stiffness: tuple[float, ...]
    tilt: tuple[float, ...]
    rate: float
    max_step: float
    model_step: float
    low: Tensor  # (n,)
    high: Tensor  # (n,)
    input_map: tuple[float, ...] = ()  # (n · m)
    start: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    spreads: Mapping[str, float] = field(default_factory=dict)

    @property
    def inputs(self) -> int:
        """Number of recorded inputs m."""
        return len(self.input_map) // len(self.angles)

    def stepped(self, times: float) -> Baseline:
        """The baseline of data whose steps are longer by the factor `times`."""
        return replace(self, max_step=times * self.max_step, model_step=times * self.model_step)


def _check_moved(data: Trajectories, speed: list[float]) -> None:
    still = [name for name, moved in zip(data.names, speed, strict=True) if moved == 0]
    remedy = f"leave it out: --drop {','.join(still)} (drop= in Python)" if len(still) < data.dof else "record a motion"
    if still:
        raise InputError(f"{data.source or 'data'}: coordinate '{still[0]}' never moves; {remedy}")


def estimate_baseline(data: Trajectories, *, outliers: bool = False, drag: bool = False, substeps: int = 1) -> Baseline:
    """Fit q̈ᵢ = −kᵢ sin qᵢ − bᵢ cos qᵢ − γ q̇ᵢ + (G u)ᵢ (angles) or −kᵢ qᵢ − bᵢ − γ q̇ᵢ + (G u)ᵢ to finite differences.

    With `drag` d (affine level) the right-hand side has Σⱼ dⱼ q̇ⱼ q̇ᵢ − dᵢ|q̇|²/2 as well, the motion of
    L = |q̇|²/2 − V + s d·q̇. A constant V acts there as a force dV, so the weight of a single coordinate, −b, starts as
    V = −b/d.

    Noise biases second differences, so these numbers only start a fit. With `outliers` Student's t replaces least
    squares (`problems.robust`), and samples with gross errors do not count for scale and speed. Trajectory fitting
    takes `substeps` model steps per recorded step. Raise InputError if a coordinate does not move.
    """
    found = differences(data, drag)
    t, v, a, max_step = found.triples, found.v, found.a, found.max_step
    n, m = data.dof, 0 if data.u is None else data.u.shape[1]
    q, (rows, right) = data.q, found.equations
    fitted = robust_fit(rows, right) if outliers else least_squares(rows, right)
    if outliers:
        r = rows @ fitted - right
        good = (r.abs().reshape(a.shape).amax(1) <= GROSS * scale_of(r)).to(q.device)
        q, v = t.q1[good], v[good]
    x = fitted[:, 0].tolist()
    # The scale of a rotating angle is half a turn.
    scale = [min(x, math.pi) if angle else x for x, angle in zip(q.abs().amax(0).tolist(), data.angles, strict=True)]
    speed = [float(s) for s in v.abs().amax(0)]
    _check_moved(data, speed)
    # A rate from noisy differences can be negative; then a small damping of the right order replaces it.
    typical = min(v / s for v, s in zip(speed, scale, strict=True))
    rate = x[2 * n] if x[2 * n] > 1e-3 * typical else 1e-2 * typical
    tilt, start = x[1 : 2 * n : 2], {}
    if drag:
        d = x[len(x) - n :]
        start["damping.drag"] = tuple(d)
        if n == 1 and not data.angles[0] and d[0] != 0:
            start["potential.features.sum.coefficient"], tilt = (-tilt[0] / d[0],), [0.0]
    return Baseline(
        angles=tuple(data.angles),
        scale=tuple(scale),
        speed=tuple(speed),
        stiffness=tuple(x[0 : 2 * n : 2]),
        tilt=tuple(tilt),
        rate=rate,
        max_step=max_step,
        model_step=max_step if substeps == 1 else JITTER * data.typical_step / substeps,
        low=q.amin(0),
        high=q.amax(0),
        input_map=tuple(x[2 * n + 1 : 2 * n + 1 + n * m]),
        start=start,
    )


def across_translations(base: Baseline, data: Trajectories, translations: Sequence[str], **how: bool) -> Baseline:
    """The baseline with springs and rate of the motion across the translations; a drift along them would hide both."""
    P = projection(translations, data.angles)
    if P is None:
        return base
    # A translated coordinate keeps its own motion; its model has no spring.
    P = P + torch.diag((P == 0).all(1).to(P.dtype))
    own = estimate_baseline(replace(data, q=data.q @ P.to(data.q)), **how)
    return replace(base, stiffness=own.stiffness, tilt=own.tilt, rate=own.rate)


def outliers_pull(data: Trajectories, *, drag: bool = False) -> bool:
    """True if outliers in runs (no single spikes) pull the least-squares start away from the other samples.

    Two conditions: accelerations jump from sample to sample (a smooth motion has h|a| < |v| down to six samples a
    period), and least squares miss the bulk by more than rounding and three times as far as Student's t.
    """
    found = differences(data, drag)
    t, v, a = found.triples, found.v, found.a
    size = float(a.square().mean().sqrt())
    jumps = float((a * (t.h0 + t.h1)[:, None] / 2).square().mean().sqrt()) > float(v.square().mean().sqrt())
    if not jumps:
        return False
    rows, right = found.equations
    plain = scale_of(rows @ least_squares(rows, right) - right)
    robust = scale_of(rows @ robust_fit(rows, right) - right)
    return plain > max(PULLED * robust, NEGLIGIBLE * size)


class Differences(NamedTuple):
    """A linear model of accelerations by differences of three samples: velocities v, accelerations a, and columns."""

    triples: Triples
    v: Tensor  # (T, n)
    a: Tensor  # (T, n)
    columns: Tensor  # (T, n, k)
    max_step: float

    @property
    def equations(self) -> tuple[Tensor, Tensor]:
        """One row for each acceleration: columns (T · n, k) and accelerations (T · n, 1), on the CPU."""
        return self.columns.flatten(0, 1).cpu(), self.a.reshape(-1, 1).cpu()


def differences(data: Trajectories, drag: bool = False) -> Differences:
    """Velocities, accelerations, and the columns of `estimate_baseline`; longer steps than `max_step` are gaps."""
    max_step = GAP * data.typical_step
    t = data.triples(max_step)
    if len(t) == 0:
        raise InputError(f"{data.source or 'data'}: no three samples in a row without a gap; record at equal steps")
    h0, h1 = t.h0[:, None], t.h1[:, None]
    a = 2 * ((t.q2 - t.q1) / h1 - (t.q1 - t.q0) / h0) / (h0 + h1)
    n, v, u = data.dof, t.v, data.inputs_of_steps()
    m = 0 if u is None else u.shape[1]
    columns = a.new_zeros(len(t), n, 2 * n + 1 + n * m)
    for i, angle in enumerate(data.angles):
        columns[:, i, 2 * i] = -(t.q1[:, i].sin() if angle else t.q1[:, i])
        columns[:, i, 2 * i + 1] = -(t.q1[:, i].cos() if angle else torch.ones_like(t.q1[:, i]))
        columns[:, i, 2 * n] = -v[:, i]
        if u is not None:
            columns[:, i, 2 * n + 1 + i * m : 2 * n + 1 + (i + 1) * m] = (u[t.index] + u[t.index + 1]) / 2
    if drag:
        half = torch.diag_embed(v.square().sum(-1, keepdim=True).expand(-1, n)) / 2
        columns = torch.cat([columns, v[:, :, None] * v[:, None] - half], -1)
    return Differences(t, v, a, columns, max_step)


def acceleration_terms(data: Trajectories) -> Differences:
    """The terms of `estimate_baseline`, and for each coordinate second harmonics or powers, and its own friction.

    Angles have second harmonics, lengths the powers 2 and 3; friction is viscous and quadratic.
    """
    found = differences(data)
    own = []
    for q, w, angle in zip(found.triples.q1.T, found.v.T, data.angles, strict=True):
        waves = [(2 * q).sin(), (2 * q).cos()] if angle else [q.square(), q**3]
        own.append(torch.stack([*waves, w, w * w.abs()], -1))
    return found._replace(columns=torch.cat([found.columns, for_each(torch.stack(own, 1))], -1))


def for_each(own: Tensor) -> Tensor:
    """Columns (T, n, k) of each coordinate in its own equation, with coefficients of its own, (T, n, n k)."""
    return (torch.eye(own.shape[1]).to(own)[:, :, None] * own[:, None]).flatten(2)
