"""Times of the rows of a table: repeated stamps, and columns that were sampled at different times.

A clock may count more slowly than samples come, and a row may be written twice: `without_repeats`.

A sample of the motion is a row in which a coordinate is known. An input is needed between its own samples, too: the
input is held from sample to sample, or interpolated linearly, and a step of the motion takes the mean of the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.clocks import numbers_of_rows
from herglotz.data.csv_columns import Columns
from herglotz.data.holds import CUBIC_POINTS, between
from herglotz.data.trajectories import Trajectories

# Stamps within this part of a count are whole counts: decimal numbers are rounded in float64.
COUNT_TOLERANCE = 1e-3
# With fewer changes all distances between the changes of an input may be k or k + 1 rows by chance.
MIN_CHANGES = 20
# Each of the two distances has at least this share; a smaller share comes from missing rows, not from a second clock.
MIN_SHARE = 0.1


class Recording(NamedTuple):
    """The rows of one trajectory, and its label, "" if the table has one trajectory."""

    label: str
    at: np.ndarray  # (n,) number of each row in the file
    values: np.ndarray  # (n, k) time, coordinates, s, momenta, inputs; NaN for a missing value


def in_order(one: Recording) -> Recording:
    """The recording with its rows sorted by time, if the times of each column increase, as in stacked tables.

    Rows of equal time become a single row if they hold different columns. All other rows stay unchanged.
    """
    t, known = one.values[:, 0], ~np.isnan(one.values)
    if (np.diff(t) < 0).any() and all((np.diff(t[known[:, k]]) > 0).all() for k in range(1, known.shape[1])):
        order = np.argsort(t, kind="stable")
        one = Recording(one.label, one.at[order], one.values[order])
    t, values = one.values[:, 0], one.values.copy()
    kept, first = np.ones(len(t), dtype=bool), 0
    for k in (np.flatnonzero(np.diff(t) == 0) + 1).tolist():
        first = k - 1 if kept[k - 1] else first
        new, old = ~np.isnan(values[k]), ~np.isnan(values[first])
        if not (new & old)[1:].any():
            values[first] = np.where(new, values[k], values[first])
            kept[k] = False
    return Recording(one.label, one.at[kept], values[kept])


def without_repeats(one: Recording, columns: Columns) -> tuple[Recording, str]:
    """The recording with increasing stamps, and a note on the repair; unchanged if no stamp repeats or some decrease.

    If all stamps are whole counts, and a clock of equal steps misses no stamp by more than a count, the number of a row
    on the clock gives its time. Rows may be lost (`herglotz.data.clocks`); where the stamps do not tell beside which
    rows, the row keeps its inputs alone. Otherwise the first row of each stamp is kept.
    """
    t, unit = one.values[:, 0], columns.units[columns.time] or "s"
    d = np.diff(t)
    if not (d == 0).any() or (d < 0).any() or not (d > 0).any():
        return one, ""
    count, twice = float(d[d > 0].min()), d == 0
    # Whether each of these rows is that before it, written twice.
    same = np.array_equal(one.values[1:][twice], one.values[:-1][twice], equal_nan=True)
    if int(twice.sum()) >= MIN_SAMPLES and not same and (found := _on_a_clock(t, count)) is not None:
        times, h, known = found
        values = np.column_stack([times, one.values[:, 1:]])
        values[~known, 1 : values.shape[1] - len(columns.u)] = np.nan
        size, step = (f"{x:.4g}" + ("" if unit == "1" else f" {unit}") for x in (count, h))
        how = "as their number says" if known.all() else (
            f"and some are missing: {int((~known).sum())} rows, whose stamps do not tell beside which rows, "
            "have no position"
        )  # fmt: skip
        return Recording(one.label, one.at, values), (
            f"warning: {int(twice.sum())} of {len(t)} rows have the stamp of the row before: stamps count {size}, and "
            f"rows are taken to be {step} apart, {how}"
        )
    kept, rows = np.concatenate([[True], ~twice]), one.at[1:][twice]
    some = "a row is" if len(rows) == 1 else f"{len(rows)} rows are"
    note = f"warning: {some} left out, with the stamp of the row before: the first is row {rows[0]}"
    return Recording(one.label, one.at[kept], one.values[kept]), note


def _on_a_clock(t: np.ndarray, count: float) -> tuple[np.ndarray, float, np.ndarray] | None:
    """The times (N,) of rows on a clock of equal steps, the step, and whether the number of a row is known, (N,) bool.

    None if the stamps are no whole counts, or no clock meets all of them to within a count.
    """
    counts = (t - t[0]) / count
    if not bool((np.abs(counts - counts.round()) <= COUNT_TOLERANCE).all()):
        return None
    every = np.ones(len(t), dtype=bool)
    for clock in (lambda: (np.arange(len(t)), every), lambda: numbers_of_rows(counts.round(), COUNT_TOLERANCE)):
        if (found := clock()) is not None:
            number, known = found
            # Sums of times near the largest number are infinite: no clock meets these.
            with np.errstate(over="ignore", invalid="ignore"):
                x, y = number - number[known].mean(), t - t[known].mean()
                h = float(x[known] @ y[known] / (x[known] @ x[known]))
                met = bool((np.abs(h * x - y) <= count).all())
            if met:
                return t[known].mean() + h * x, h, known
    return None


def completed(
    recordings: Sequence[Recording], columns: Columns, hold: str
) -> tuple[list[Recording], tuple[str, ...], str]:
    """The recordings with interpolated coordinates and filled inputs, notes for the user, and the hold of the inputs.

    If neither user nor file gives a hold, and most samples of the motion have no input of their own, the hold is
    "zero".
    """
    q, u = slice(1, 1 + len(columns.q)), slice(len(columns.numeric) - len(columns.u), len(columns.numeric))
    straight, unit, notes = hold in ("first", "smooth"), columns.units[columns.time] or "s", []
    aligned = [_together(one, q) for one in recordings]
    if any(one is not before for one, before in zip(aligned, recordings, strict=True)):
        names = " and ".join(columns.names[i] for i in columns.q)
        notes.append(f"warning: {names} are seldom in one row, and are interpolated at the times of the rarest")
    blank = np.isnan(np.concatenate([one.values for one in aligned]))
    if not blank[:, u].any():
        return aligned, tuple(notes), hold
    filled = [_filled(one, u, straight) for one in aligned]
    names = [columns.names[i] for k, i in enumerate(columns.u) if blank[:, u.start + k].any()]
    notes.append(_fill_note(names, hold, max(longest for _, longest in filled), unit))
    sample = ~blank[:, q].any(1)
    own_rate = 2 * int(blank[sample][:, u].any(1).sum()) > int(sample.sum())
    return [one for one, _ in filled], tuple(notes), hold or ("zero" if own_rate else "")


def _together(one: Recording, q: slice) -> Recording:
    """The recording with the values of all coordinates in the same rows.

    If most samples of the rarest coordinate stand in rows without another coordinate, the others are interpolated at
    the times of the rarest, by cubics through neighbouring samples. Rows without the rarest coordinate stay.
    """
    known = ~np.isnan(one.values[:, q])
    counts = known.sum(0)
    base = int(counts.argmin())
    if counts[base] < CUBIC_POINTS or 2 * int(known.all(1).sum()) >= counts[base]:
        return one
    values = one.values.copy()
    rows = np.flatnonzero(known[:, base])
    for k in range(known.shape[1]):
        if k != base:
            own = known[:, k]
            t, at = values[own, 0], values[rows, 0]
            cubic = between(*map(torch.from_numpy, (t, one.values[own, q.start + k], at))).numpy()
            values[rows, q.start + k] = np.where((at >= t[0]) & (at <= t[-1]), cubic, np.nan)
    return Recording(one.label, one.at, values)


def _filled(one: Recording, u: slice, straight: bool) -> tuple[Recording, float]:
    """The recording with its inputs in every row, and the longest time for which an input was held.

    An input stays unknown before its first sample. After the last sample the input is known for the median distance
    of its samples, or not at all if `straight` lines connect the samples.
    """
    t, values, longest = one.values[:, 0], one.values.copy(), 0.0
    for x in values[:, u].T:
        known = np.flatnonzero(~np.isnan(x))
        if len(known) in (0, len(x)):
            continue
        last = known[np.maximum(np.searchsorted(known, np.arange(len(x)), side="right") - 1, 0)]
        apart = float(np.median(np.diff(t[known]))) if len(known) > 1 else np.inf
        inside = (t >= t[known[0]]) & (t <= t[known[-1]] + (0.0 if straight else apart))
        longest = max(longest, float((t - t[last])[inside].max()))
        x[:] = np.where(inside, np.interp(t, t[known], x[known]) if straight else x[last], np.nan)
    return Recording(one.label, one.at, values), longest


def _fill_note(names: Sequence[str], hold: str, longest: float, unit: str) -> str:
    """The note on inputs that have no value in some rows; a stated hold needs no remedy."""
    some = f"{', '.join(names)} {'has' if len(names) == 1 else 'have'} no value in some rows"
    if hold in ("first", "smooth"):
        return f"{some}; straight lines go there from the row before to the row behind"
    size = f"{longest:.3g}" if unit == "1" else f"{longest:.3g} {unit}"
    remedy = "" if hold else "; a fit with --hold first (hold= in Python) draws straight lines"
    return f"warning: {some}: the last one is held, for up to {size}{remedy}"


def filled_inputs(data: Trajectories) -> list[str]:
    """Names of inputs that a slower clock recorded, and the logger filled in: these change every k or k + 1 rows.

    If both clocks run together, the input changes every k rows alone; a signal that steps by itself changes after any
    number of rows.
    """
    labels = [name for name, _ in data.input_labels]
    return [name for name, u in zip(labels, [] if data.u is None else data.u.T, strict=True) if _filled_in(data, u)]


def _filled_in(data: Trajectories, u: torch.Tensor) -> bool:
    """Whether all changes of an input (N,) are k or k + 1 rows apart, with at least `MIN_SHARE` of each."""
    steps = data.steps()
    at = (u[steps.index + 1] != u[steps.index]).nonzero()[:, 0]
    apart = (steps.index[at].diff())[steps.trajectory[at].diff() == 0]
    numbers, counts = apart.unique(return_counts=True)
    return (
        len(apart) >= MIN_CHANGES
        and len(numbers) == 2
        and int(numbers[1] - numbers[0]) == 1
        and float(counts.min() / counts.sum()) > MIN_SHARE
    )
