"""How a recorded input reaches the machine, and the times and inputs of a rollout that a recording drives.

A recorded input acts later by a delay, and through an actuator's lag. With the recorded u(t), between samples as its
hold says, the input that acts is u_f of

    lag · u_f′(t) = u(t − delay) − u_f(t),

constant before the first sample. Every hold makes u of straight pieces (a polynomial is cut into `PIECES_PER_STEP` of
them), and on a piece a + b x that starts at x = 0

    u_f = a + b (x − lag) + (u_f(0) − a + b lag) e^(−x/lag),     ∫u_f = ∫u(t − delay) − lag (u_f − u_f(0)):

values and means are exact. The stepper takes the acting input of each step; it knows neither delay nor lag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from herglotz.data.holds import UNSPECIFIED, Arrival, interpolated_input
from herglotz.data.input_terms import input_terms_of, with_input_terms
from herglotz.data.readers import load
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError, refuse

# Straight pieces of a polynomial between samples. At nine samples a period they miss the polynomial by a thousandth.
PIECES_PER_STEP = 8


def acting(data: Trajectories, default: Arrival = UNSPECIFIED) -> Trajectories:
    """The recording with its acting inputs; `default` has hold, delay and lag where the recording has none."""
    if data.u is None:
        return data
    late = [own if own is not None else other for own, other in zip(data.arrival[1:], default[1:], strict=True)]
    arrival, u = Arrival(data.hold or default.hold, *late), data.u
    if any(arrival.late):
        u = InputPieces.of(arrival.hold, data.t, u, data.lengths).acting(*arrival.late).to(u)
    return replace(data, u=u, hold=arrival.hold, delay=0.0, lag=0.0)


@dataclass(frozen=True)
class InputPieces:
    """Recorded inputs as P straight pieces, trajectory after trajectory on one axis of time.

    `leads` marks the first piece of a trajectory, and `constant` the hold "zero".
    """

    times: Tensor  # (N,) of the samples
    begins: Tensor  # (N,) of their trajectories
    last: Tensor  # (B,) sample that ends each trajectory
    left: Tensor  # (P,) start of each piece
    width: Tensor  # (P, 1)
    value: Tensor  # (P, m) at the start
    slope: Tensor  # (P, m)
    leads: Tensor  # (P, 1) bool
    constant: bool

    @classmethod
    def of(
        cls,
        hold: str,
        t: Tensor,  # (N,)
        u: Tensor,  # (N, m)
        lengths: Sequence[int],
    ) -> InputPieces:
        """The pieces of recorded inputs u, in float64; a hold that is not specified ("") is "zero"."""
        t, u, counts, constant = t.double().cpu(), u.double().cpu(), torch.tensor(lengths), hold in ("", "zero")
        last = counts.cumsum(0) - 1
        first = last + 1 - counts
        # The longest step keeps trajectories apart on the axis of time.
        spans = t[last] - t[first] + t.diff().abs().max()
        owner = torch.repeat_interleave(torch.arange(len(counts)), counts)
        begins = (spans.cumsum(0) - spans)[owner]
        times = t - t[first][owner] + begins
        steps = torch.ones_like(t, dtype=torch.bool)
        steps[last] = False
        parts = PIECES_PER_STEP if hold == "smooth" else 1
        row = steps.nonzero()[:, 0].repeat_interleave(parts)
        part = torch.arange(parts, dtype=t.dtype).repeat(len(row) // parts) / parts
        width = (times[row + 1] - times[row])[:, None] / parts
        value = interpolated_input(hold, t, u, lengths, row, part)
        slope = torch.zeros_like(value)
        if not constant:
            slope = interpolated_input(hold, t, u, lengths, row, part + 1 / parts) - value
        leads = (torch.isin(row, first) & (part == 0))[:, None]
        left = times[row] + part * parts * width[:, 0]
        return cls(times, begins, last, left, width, value, slope / width, leads, constant)

    def means(self, row: Tensor, begin: Tensor, width: Tensor) -> Tensor:
        """Mean inputs (…, m) over the times from `begin` to `begin + width` after the samples `row`, all (…)."""
        each = self.width * (self.value + self.width * self.slope / 2)
        before = each.cumsum(0) - each

        def impulse(t: Tensor) -> Tensor:
            at = (torch.searchsorted(self.left, t, right=True) - 1).clamp_min(0)
            x = (t - self.left[at])[..., None]
            return before[at] + x * (self.value[at] + x * self.slope[at] / 2)

        start = self.times[row] + begin
        return (impulse(start + width) - impulse(start)) / width[..., None]

    def acting(self, delay: float, lag: float) -> Tensor:
        """The acting inputs, (N, m): means over the steps if the hold is "zero", else values at the samples."""
        lag = max(lag, torch.finfo(self.left.dtype).tiny)
        a, b, decay = self.value, self.slope, torch.exp(-self.width / lag)
        forced = a + b * (self.width - lag)
        end = _linear_recurrence(
            torch.where(self.leads, 0.0, decay), forced - torch.where(self.leads, -b * lag, a - b * lag) * decay
        )
        start = torch.where(self.leads, a, torch.cat([a[:1], end[:-1]]))
        asked = (self.times - delay).maximum(self.begins)
        at = torch.searchsorted(self.left, asked, right=True) - 1
        x = (asked - self.left[at])[:, None]
        value = a[at] + b[at] * (x - lag) + (start[at] - a[at] + b[at] * lag) * torch.exp(-x / lag)
        if not self.constant:
            return value
        # ∫u up to the start of each piece, and the part of the delayed time that lies before the first sample.
        before = (self.width * a).cumsum(0) - self.width * a
        early = (self.times - delay - asked)[:, None]
        total = before[at] + a[at] * (x + early) - lag * value
        mean = torch.cat([total.diff(dim=0) / self.times.diff()[:, None], value[-1:]])
        # No step starts at the last sample of a trajectory.
        mean[self.last] = value[self.last]
        return mean


def _linear_recurrence(factor: Tensor, add: Tensor) -> Tensor:
    """y_j = factor_j y_{j−1} + add_j for all j at once, by doubling."""
    by, y, reach = factor, add, 1
    while reach < len(y) and bool((by > 0).any()):
        y = torch.cat([y[:reach], y[reach:] + by[reach:] * y[:-reach]])
        by = torch.cat([by[:reach], by[reach:] * by[:-reach]])
        reach *= 2
    return y


# A start within this part of a step of a recorded time is at that time.
START_TOLERANCE = 1e-3


def clean(values: Tensor) -> Tensor:
    """Numbers rounded to 14 digits, so that 0.1 + 0.2 prints as 0.3."""
    return torch.tensor([float(f"{x:.14g}") for x in values.double().tolist()], dtype=torch.float64)


def even_times(t0: float, h: float, steps: int) -> Tensor:
    """The times of K equal steps from t0, (K + 1,)."""
    return clean(t0 + float(f"{h:.12g}") * torch.arange(steps + 1, dtype=torch.float64))


def input_recording(
    path: str | Path | Trajectories,
    trajectory: int,
    time_unit: str,
    default: Arrival = UNSPECIFIED,
    known: Sequence[Sequence[str]] = (),
) -> Trajectories:
    """The recording whose inputs drive the model: the trajectory of that number, or the only trajectory.

    A file needs times and inputs alone; `known` are the columns of the fit: name, role, unit. The returned inputs are
    the acting inputs, by the file's own hold, delay and lag, or else by `default`. Raise InputError if the file holds
    no inputs, has no such trajectory, or counts time in another unit.
    """
    if isinstance(path, Trajectories):
        found = path
    else:
        found = load(path, known=tuple(map(tuple, known)), known_hold=default.hold, motion=False)
    path = found.source or "recording"
    found = acting(found if found.u is None else with_input_terms(found, input_terms_of(known)), default)
    trajectory = 0 if len(found) == 1 else trajectory
    count, unit = len(found), found.time_unit
    refuse({
        f"inputs {path}: holds no inputs; name their columns u, u_*, force or torque": found.u is None,
        f"inputs {path}: time is in {unit}, the model's in {time_unit}; convert it": unit != time_unit,
        f"inputs {path}: there is no trajectory {trajectory}; choose one from 0 to {count - 1}": trajectory >= count,
    })  # fmt: skip
    return found[trajectory]


def driven(found: Trajectories, t0: float, steps: int, h: float | None) -> tuple[Tensor, Tensor]:
    """Inputs (K, m) and times (K + 1,) of K steps from t0: the recording's own steps, or steps of h.

    A recorded step takes the input of its hold; a step of h takes the mean input over its time. Raise InputError if the
    recording does not cover these steps, or if recorded steps are taken and no sample is at t0.
    """
    t, u = found.t.double(), found.inputs_of_steps()
    # `input_recording` has refused recordings without inputs.
    assert u is not None
    where, spans = f"inputs {found.source}", f"the recording spans {float(t[0]):g} to {float(t[-1]):g}"
    if h is None:
        row = int((t - t0).abs().argmin())
        if abs(float(t[row]) - t0) > START_TOLERANCE * found.typical_step:
            remedy = "give t0 (--t0), or h (--h) for equal steps"
            raise InputError(f"{where}: no sample at the start t = {t0:g}; {spans}: {remedy}")
        if row + steps >= len(t):
            raise InputError(f"{where}: {steps} steps from t = {t0:g} need {row + steps + 1} samples, it has {len(t)}")
        return u[row : row + steps], t[row : row + steps + 1]
    times = even_times(t0, h, steps)
    slack = START_TOLERANCE * h
    if float(times[0]) < float(t[0]) - slack or float(times[-1]) > float(t[-1]) + slack:
        raise InputError(f"{where}: the rollout lasts from {t0:g} to {float(times[-1]):g}, but {spans}; give t0 (--t0)")
    total = torch.cat([torch.zeros_like(u[:1]), (u[:-1] * t.diff()[:, None]).cumsum(0)])
    at = torch.searchsorted(t, times).clamp(1, len(t) - 1)
    # ∫u grows linearly from the last sample before each time.
    passed = (times - t[at - 1])[:, None]
    integral = total[at - 1] + u[at - 1] * passed
    return integral.diff(dim=0) / times.diff()[:, None], times
