"""Repeated time stamps: a clock that counts more slowly than samples come, or rows that were written twice."""

from __future__ import annotations

import numpy as np

from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.rates import Recording

# Stamps within this part of a count are whole counts: decimal numbers are rounded in float64.
COUNT_TOLERANCE = 1e-3


def without_repeats(one: Recording, unit: str) -> tuple[Recording, str]:
    """The recording with increasing stamps, and a note on the repair; unchanged if no stamp repeats or some decrease.

    If all stamps are whole counts, and equal steps miss no stamp by more than a count, the samples were taken in equal
    steps: the number of a sample gives its time. Otherwise the first row of each stamp is kept.
    """
    t = one.values[:, 0]
    d = np.diff(t)
    if not (d == 0).any() or (d < 0).any() or not (d > 0).any():
        return one, ""
    count, steps = float(d[d > 0].min()), np.arange(len(t)) - (len(t) - 1) / 2
    h = float(steps @ (t - t.mean()) / (steps @ steps))
    even, counts = t.mean() + h * steps, (t - t[0]) / count
    whole = bool((np.abs(counts - counts.round()) <= COUNT_TOLERANCE).all()) and bool((np.abs(even - t) <= count).all())
    twice = d == 0
    same = _written_twice(one.values[1:][twice], one.values[:-1][twice])
    if whole and int(twice.sum()) >= MIN_SAMPLES and not same:
        values = np.column_stack([even, one.values[:, 1:]])
        size, step = (f"{x:.4g}" + ("" if unit == "1" else f" {unit}") for x in (count, h))
        note = f"warning: stamps repeat in counts of {size}; rows are taken to be {step} apart, as their number says"
        return Recording(one.label, one.at, values), note
    kept, rows = np.concatenate([[True], ~twice]), one.at[1:][twice]
    some = "a row is" if len(rows) == 1 else f"{len(rows)} rows are"
    note = f"warning: {some} left out, with the stamp of the row before: the first is row {rows[0]}"
    return Recording(one.label, one.at[kept], one.values[kept]), note


def _written_twice(rows: np.ndarray, before: np.ndarray) -> bool:
    """Whether each of these rows equals the row before."""
    return bool(((rows == before) | (np.isnan(rows) & np.isnan(before))).all())
