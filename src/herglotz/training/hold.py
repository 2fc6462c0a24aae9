"""How recorded inputs arrive, where neither the data nor the user say so: the hold, a delay and the actuator's lag.

Each arrival (`herglotz.data.driving`) makes other inputs of the steps. One linear problem compares them: accelerations
by differences against `acceleration_terms`, dry friction and the forces of other joints. Differences amplify noise, so
that the problem is turned back into one of positions over short windows, whose noise is white. An arrival is taken if
it lowers the error by more than a tenth and beyond the spread of that gain over blocks of time: first a hold, then a
delay or a lag, then both. There is no delay or lag where inputs that act at once, by their rates too, are better than
it by the same measure.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.driving import InputPieces, acting
from herglotz.data.holds import HOLDS, SAMPLES, Arrival
from herglotz.data.smoothing import slopes, smoothed
from herglotz.data.splits import liveliest_rows
from herglotz.data.windows import Triples
from herglotz.least_squares import least_squares
from herglotz.training.baseline import acceleration_terms, differences, for_each

# Least mean over blocks of log(mean square without / with). Measured: 0.36 to 3.9 for delays of 0.4 and 2.3 steps that
# noise of 1 % lets see, up to 0.16 for errors of the linear model itself.
MIN_LOG_GAIN = 0.2
# Blocks of time, and the standard errors over them that a gain must exceed.
BLOCKS, MIN_STANDARD_ERRORS = 10, 3.0
# Most samples that are compared.
MAX_SAMPLES = 3000
# Delays and lags that are tried, in typical steps.
TRIED = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
# Typical steps before the compared samples whose inputs still act: forty times the longest lag forgets to 1e-17.
REMEMBERED = int(41 * TRIED[-1])
# Least delay and lag together, in typical steps: errors of the linear model itself look like up to 0.27 of a step.
MIN_LATENESS = 0.3
# Shortest step of the search, in typical steps.
FINEST = 2e-3
# Directions of the search in (delay, lag); the data determine the sum best.
DELAY, LAG = (1, 0), (0, 1)
# Steps of a descent, along each axis and along both at once.
MOVES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1))
# Most triples in a window.
LONGEST = 64
# Widths of dry friction, in RMS velocities.
SMOOTHED = (0.01, 0.1, 0.3)
# Dry friction may hold a coordinate that is slower, in RMS velocities, against its input.
STILL = 0.1
# Singular values below this share of the largest belong to columns that repeat others.
RANK = 1e-9


def with_arrival(data: Trajectories, train: Trajectories) -> tuple[Trajectories, Arrival, dict[str, str]]:
    """The data with their inputs as they act, how recorded inputs arrive, and the reasons.

    What the data do not say is found from `train`, the part of the data that a fit may see.
    """
    arrival = data.arrival
    if data.u is None:
        return data, arrival, dict.fromkeys(Arrival._fields, "there are no inputs")
    free = [name for name, value in arrival._asdict().items() if value in ("", None)]
    reasons = dict.fromkeys(Arrival._fields, "the data or the settings say so")
    if free:
        arrival, numbers = _searched(train, arrival)
        reasons |= dict.fromkeys(free, numbers)
    return acting(replace(data, **arrival._asdict())), arrival, reasons


@dataclass(frozen=True)
class Way:
    """An arrival of the inputs, and the errors of the linear model with it."""

    arrival: Arrival
    errors: Tensor  # (BLOCKS,) mean squares over blocks of time

    @property
    def rms(self) -> float:
        """The error over all blocks."""
        return float(self.errors.mean().sqrt())

    def beats(self, other: Way) -> bool:
        """Whether the error is lower by a tenth and beyond the spread over blocks, which one block cannot decide."""
        gain = (other.errors / self.errors.clamp_min(torch.finfo(self.errors.dtype).tiny)).log()
        return float(gain.mean()) > max(MIN_LOG_GAIN, MIN_STANDARD_ERRORS * float(gain.std()) / BLOCKS**0.5)


def _searched(train: Trajectories, said: Arrival) -> tuple[Arrival, str]:
    """The arrival that explains the motion best, where `said` leaves it open, and the numbers that say so."""
    ways = Ways(train)
    plain = [ways.of(Arrival(hold, *said.late)) for hold in ([said.hold] if said.hold else HOLDS)]
    best = min(plain, key=lambda way: way.rms)
    found = best if best.beats(plain[0]) else plain[0]
    compared = {way.arrival.hold: way for way in plain}
    axes = {name: axis for name, axis, x in (("a delay", DELAY, said.delay), ("a lag", LAG, said.lag)) if x is None}
    singles = {name: ways.along(axis, found.arrival) for name, axis in axes.items()}
    compared |= singles
    single = min(singles.values(), key=lambda way: way.rms, default=found)
    late = ways.is_late(single.arrival, found.arrival) and single.beats(found)
    # A force by the rate of the input looks like a delay, which is no explanation where the rate explains far more.
    if late and not ways.of(found.arrival, rates=True).beats(single):
        found = single
        if len(axes) == 2:
            compared["both"] = both = ways.nearby(single, MOVES, 0.5)
            found = both if both.beats(single) else single
    numbers = ", ".join(f"{name} {way.rms:.3g}" for name, way in compared.items())
    return found.arrival, f"a linear model over short windows misses positions by: {numbers}"


class Ways:
    """The errors of the linear model of these data, by the arrival of the inputs."""

    def __init__(self, data: Trajectories):
        data = data.to(torch.float64, "cpu")
        rows, lengths = liveliest_rows(data.q, data.lengths, MAX_SAMPLES)
        self.step, self.problem = data.typical_step, Accelerations(data.rows(rows, lengths))
        self.all, self.rows = _with_past(data, rows, lengths)
        recorded = self.all.u
        assert recorded is not None
        self.pieces = cache(lambda hold: InputPieces.of(hold, self.all.t, recorded, self.all.lengths))

    def of(self, arrival: Arrival, *, rates: bool = False) -> Way:
        """An arrival with its errors; `rates`: inputs may also act by their rates."""
        u = self.pieces(arrival.hold).acting(*arrival.late)
        u = torch.cat([u, slopes(self.all, u)], 1) if rates else u
        u = replace(self.all, u=u, hold=arrival.hold).inputs_of_steps(self.rows)
        assert u is not None
        return Way(arrival, self.problem.errors(u))

    def along(self, axis: tuple[int, int], plain: Arrival) -> Way:
        """The best delay, or the best lag."""
        tried = [(x, self._moved(plain, axis, x)) for x in TRIED]
        best, x = min(
            ((self.of(arrival), x) for x, arrival in tried if arrival is not None), key=lambda found: found[0].rms
        )
        return self.nearby(best, (axis, (-axis[0], -axis[1])), x / 4)

    def is_late(self, found: Arrival, plain: Arrival) -> bool:
        """Whether `found` is later by more than the linear model may err, and not at the end of the range."""
        later = sum(found.late) - sum(plain.late)
        return later >= MIN_LATENESS * self.step and max(found.late) < TRIED[-1] * self.step

    def nearby(self, way: Way, moves: Sequence[tuple[int, int]], size: float) -> Way:
        """The best arrival that steps of this size along the moves lead to; the size halves where no step helps."""
        while size > FINEST:
            moved = [self._moved(way.arrival, move, size) for move in moves]
            best = min((self.of(x) for x in moved if x is not None), key=lambda other: other.rms, default=way)
            if best.rms < way.rms:
                way = best
            else:
                size /= 2
        return way

    def _moved(self, arrival: Arrival, move: tuple[int, int], size: float) -> Arrival | None:
        """The arrival moved by so many typical steps; None outside the range of delays and lags."""
        delay, lag = (x + by * size * self.step for x, by in zip(arrival.late, move, strict=True))
        allowed = min(delay, lag) >= 0 and max(delay, lag) <= TRIED[-1] * self.step
        return arrival._replace(delay=delay, lag=lag) if allowed else None


def _with_past(data: Trajectories, rows: Tensor, lengths: Sequence[int]) -> tuple[Trajectories, Tensor]:
    """The samples whose inputs act in these runs of rows, and where the rows are among the samples."""
    kept = []
    for run in rows.split(list(lengths)):
        own = int(data.trajectory[run[0]])
        begin, end = data.offsets[own], data.offsets[own] + data.lengths[own]
        last = min(end, int(run[-1]) + 1 + SAMPLES["smooth"])
        kept.append(torch.arange(max(begin, int(run[0]) - REMEMBERED), last))
    every = torch.cat(kept)
    return data.rows(every, tuple(map(len, kept))), torch.searchsorted(every, rows)


class Accelerations:
    """The part of the accelerations that no term of the linear problem explains, for the inputs to explain."""

    def __init__(self, data: Trajectories):
        data = replace(data, u=None)
        triples, _, a, _, _ = differences(data)
        terms = acceleration_terms(smoothed(data))
        q = terms.triples.q1
        self.index, self.balance = triples.index, data.balance[:, None]
        self.rows, self.factor = _windows(triples, data)
        turning = [q[:, i] for i, angle in enumerate(data.angles) if angle and data.dof > 1]
        self.directions = torch.stack(
            [torch.ones_like(q[:, 0]), *(f(x) for x in turning for f in (torch.sin, torch.cos))], -1
        )
        slow = terms.v / terms.v.square().mean(0).sqrt()
        columns = [terms.columns, *(torch.diag_embed(torch.tanh(slow / width)) for width in SMOOTHED)]
        self.still = (slow.abs() < STILL).to(q)
        if data.dof > 1:
            others = torch.cat(list(_forces_of_others(data.angles, q, terms.v)), -1)
            columns.append(for_each(others[:, None].expand(-1, data.dof, -1)))
        U, S, _ = torch.linalg.svd(_scaled(self._whitened(torch.cat(columns, -1))), full_matrices=False)
        self.Q = U[:, RANK * S[0] < S]
        self.y = self._unexplained(a[..., None])

    def errors(self, u: Tensor) -> Tensor:
        """Mean squares over blocks of time, (BLOCKS,), with these inputs of the steps, (N, m)."""
        each = (u[self.index] + u[self.index + 1]) / 2
        each = (each[:, :, None] * self.directions[:, None]).flatten(1)
        A = for_each(each[:, None].expand(-1, len(self.balance), -1))
        A = _scaled(self._unexplained(torch.cat([A, A * self.still[:, :, None]], -1)))
        left = A @ least_squares(A, self.y) - self.y
        return torch.stack([block.square().mean() for block in left.tensor_split(BLOCKS)])

    def _unexplained(self, x: Tensor) -> Tensor:
        """The part of the columns (T, n, k) that the terms do not explain, (T' n, k)."""
        x = self._whitened(x)
        return x - self.Q @ (self.Q.T @ x)

    def _whitened(self, x: Tensor) -> Tensor:
        """(T, n, k) over the balance, as positions whose noise is white, (T' n, k)."""
        windows = (x / self.balance)[self.rows]
        return torch.linalg.solve_triangular(self.factor, windows.flatten(2), upper=False).reshape(-1, x.shape[-1])


def _scaled(A: Tensor) -> Tensor:
    """The columns over their RMS."""
    return A / A.square().mean(0).sqrt().clamp_min(torch.finfo(A.dtype).tiny)


def _windows(t: Triples, data: Trajectories) -> tuple[Tensor, Tensor]:
    """Triples (M, L) of windows in a row, and the factor of their accelerations' covariance, (M, L, L).

    White noise n of positions makes noise D n of accelerations, D being second differences; Σ = D Dᵀ. The noise of the
    terms, left out there, grows with time: of a spring ω² it is ω² L^{3/2} h^{1/2} / √3 as large after a time L.
    """
    omega2 = float(t.v.square().mean(0).div(t.q1.var(0)).max())
    h = data.typical_step
    longest = max(3, round((3**0.5 / (omega2 * h**0.5)) ** (2 / 3) / h)) if omega2 > 0 else 3
    runs = torch.arange(len(t)).tensor_split((t.index.diff() != 1).nonzero()[:, 0] + 1)
    longest = min(longest, LONGEST, *map(len, runs))
    starts = torch.cat([run[: len(run) - longest + 1 : longest] for run in runs])
    rows = starts[:, None] + torch.arange(longest)
    h0, h1 = t.h0[rows], t.h1[rows]
    D = t.q0.new_zeros(len(rows), longest, longest + 2)
    each = torch.arange(longest)
    for k, value in enumerate((1 / h0, -1 / h0 - 1 / h1, 1 / h1)):
        D[:, each, each + k] = 2 * value / (h0 + h1)
    return rows, torch.linalg.cholesky(D @ D.mT)


def _forces_of_others(angles: Sequence[bool], q: Tensor, v: Tensor) -> Iterable[Tensor]:
    """What each coordinate may do to the others: springs, weight, friction and centrifugal forces, (T, k)."""
    for i, angle in enumerate(angles):
        s, c, w = q[:, i].sin(), q[:, i].cos(), v[:, i]
        yield torch.stack([s, c, s * c, w, w.square() * s, w.square() * c] if angle else [q[:, i], w], -1)
