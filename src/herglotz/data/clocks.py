"""The times of samples that are taken several times within a count of their stamps, if some rows are lost.

An example is a log of 300 rows a second whose stamps are whole seconds. Row i has the stamp k_i, a whole count, and was
taken at the tick t_0 + n_i h of a clock with the step h: k_i ≤ t_0 + n_i h < k_i + 1 in counts, with whole numbers n_i
that increase. If no row is lost, n_i = i. If rows are lost, a stamp with a row for each tick in its count gives the
numbers of its rows; a stamp with fewer rows does not say which rows are lost. `numbers_of_rows` finds t_0, h and n_i.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

# The frequency of the numbers of rows is looked for in at most this many counts: their transform takes 0.1 s.
MAX_COUNTS = 2**20
# At most this many parts of a range of steps are looked at: clocks of 300 to 300 000 rows needed at most 62 parts.
MAX_PARTS = 400


def numbers_of_rows(
    stamps: np.ndarray,  # (N,) whole counts, which do not decrease, and some of which repeat
    tolerance: float,  # of a count: a sample so near to the end of its count may have the next stamp
) -> tuple[np.ndarray, np.ndarray] | None:
    """The number n_i of each row on a clock that the stamps show, (N,), and whether this number is known, (N,) bool.

    Rows whose numbers are not known are spread over the ticks of their count. None if the stamps show no clock.
    """
    at, first, own, rows = np.unique(stamps, return_index=True, return_inverse=True, return_counts=True)
    for clock in _clocks(at, rows, tolerance):
        tick, behind = clock.ticks(at, tolerance)
        ticks = (behind - tick).astype(int)
        if _is_shown(clock, at, rows, ticks):
            place = np.arange(len(stamps)) - first[own] + 0.5
            return (tick - tick[0])[own] + place * (ticks / rows)[own] - 0.5, (ticks == rows)[own]
    return None


class Clock(NamedTuple):
    """A clock with a tick at `start` and every `step` from there.

    The phase of a count is its begin modulo `step`. Counts of the most ticks without a missing row have their phases in
    the `window`, an arc as (begin, length); rounding widens the arc at both ends.
    """

    step: float
    start: float
    window: tuple[float, float]

    def ticks(self, at: np.ndarray, tolerance: float) -> np.ndarray:
        """The number of the first tick in each count, and of the first tick behind each count, (2, K)."""
        return np.ceil((np.stack([at - tolerance, at + 1 + tolerance]) - self.start) / self.step)


def _is_shown(clock: Clock, at: np.ndarray, rows: np.ndarray, ticks: np.ndarray) -> bool:
    """Whether the stamps show this clock, by the likelihood of `rows` (K,) if each of the `ticks` (K,) loses its row.

    Ticks lose their rows independently. K stamps distinguish K³ clocks, because steps differ if they are 1/K² apart,
    and starts if they are 1/K apart: chance alone can make one of these K³ times likelier. There are three conditions:

    * Stamps without a missing row have more rows together than there are stamps.
    * The clock is more than K³ times likelier than independent numbers of rows with the observed frequencies.
    * The clock is no reflection of a clock with another step, whose counts of the most ticks have a smaller window: it
      is not less likely than 1/K³ that no count beyond the window has all its rows.
    """
    most, share, price = int(rows.max()), rows.sum() / ticks.sum(), 3 * math.log(len(at))
    if bool((ticks < rows).any()) or int(rows[ticks == rows].sum()) <= len(at):
        return False
    begin, length = clock.window
    beyond = int(((ticks == most) & ((at - begin) % clock.step > length)).sum())
    if share < 1 and -beyond * math.log1p(-(share**most)) > price:
        return False
    shares = np.bincount(rows)[rows] / len(rows)
    return _log_binomial(rows, ticks) - float(np.log(shares).sum()) > price


def _clocks(at: np.ndarray, rows: np.ndarray, tolerance: float) -> Iterator[Clock]:
    """Clocks that have a tick for each row in these counts, (K,).

    With at most C rows in a count, a clock has C − 1 + φ ticks in a count, 0 < φ < 1, and φ or 1 − φ is the strongest
    frequency of the numbers of rows: that of the largest harmonic of ⌊x + φ⌋ − ⌊x⌋ is φ.
    """
    most = int(rows.max())
    near = at < at[0] + MAX_COUNTS
    numbers = np.bincount((at[near] - at[0]).astype(int), rows[near])
    strength = np.abs(np.fft.rfft(numbers - numbers.mean()))[1:]
    if not len(strength):
        return
    peak = int(strength.argmax()) + 1
    for frequency in (peak, len(numbers) - peak):
        ends = (min(max((frequency + side) / len(numbers), 0.0), 1.0) for side in (1, -1))
        low, high = (1 / (most - 1 + phi) for phi in ends)
        if clock := _in_range(at[rows == most], most, low, high, tolerance):
            yield clock


def _in_range(full: np.ndarray, most: int, low: float, high: float, tolerance: float) -> Clock | None:
    """A clock with a step h of this range that has `most` ticks in each of these counts, (F,).

    The range is halved again and again. A part is refused if each of its clocks misses a count: phases in the part
    depart from those of the clock in the middle by at most `error`. None if no part is left after `MAX_PARTS` of them.
    """
    x, todo = full - full[0], deque([(low, high)])
    for _ in range(MAX_PARTS):
        low, high = todo.popleft() if todo else (0.0, 0.0)
        h, half = (low + high) / 2, (high - low) / 2
        if not low < h < high:
            return None
        # Late stamps tell nothing of a part in which the phase departs by more than a quarter of a step.
        near = x[: max(2, int(np.searchsorted(x, low * h / (4 * half))))]
        slack, error = 1 - (most - 1) * h + tolerance, 2 * float(near[-1]) * half / low + most * half
        if _arc(near, h)[0] > slack + error:
            continue
        arc, begin = _arc(x, h)
        begin += float(full[0])
        if arc < slack and len(near) == len(x):
            return Clock(h, begin + (slack - tolerance + arc) / 2, (begin - 2 * tolerance, arc + 4 * tolerance))
        todo += [(low, h), (h, high)]
    return None


def _arc(x: np.ndarray, h: float) -> tuple[float, float]:
    """Length and begin of the shortest arc of a circle of circumference h that holds all points x."""
    phase = np.sort(x % h)
    gaps = np.diff(phase, append=phase[0] + h)
    k = int(gaps.argmax())
    return h - float(gaps[k]), float(phase[(k + 1) % len(phase)])


def _log_binomial(rows: np.ndarray, ticks: np.ndarray) -> float:
    """The log-likelihood of these numbers of rows, none of which is 0, if each tick loses its row independently."""
    kept, total = int(rows.sum()), int(ticks.sum())
    if kept == total:
        return 0.0
    share, likelihood = kept / total, 0.0
    pairs, counts = np.unique(np.stack([rows, ticks]), axis=1, return_counts=True)
    for (c, m), count in zip(pairs.T.tolist(), counts.tolist(), strict=True):
        one = math.log(math.comb(m, c)) + c * math.log(share) + (m - c) * math.log(1 - share)
        likelihood += count * (one - math.log(1 - (1 - share) ** m))
    return likelihood
