"""Stamps that repeat: a clock that counts more slowly than samples come, or rows that were written twice."""

from __future__ import annotations

import numpy as np

from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.rates import Recording

NEARLY = 1e-3  # of a count: stamps of float64 are whole counts to within this


def without_repeats(one: Recording, unit: str) -> tuple[Recording, str]:
    """The recording with stamps that increase, and what was made of those that repeat; it itself where some decrease.

    Where all stamps are whole counts and equal steps miss none of them by more than a count, the samples were taken in
    equal steps, and get their times from their number. Otherwise the first row of each stamp is kept.
    """
    t = one.values[:, 0]
    d = np.diff(t)
    if not (d == 0).any() or (d < 0).any() or not (d > 0).any():
        return one, ""
    count, steps = float(d[d > 0].min()), np.arange(len(t)) - (len(t) - 1) / 2
    h = float(steps @ (t - t.mean()) / (steps @ steps))
    even, counts = t.mean() + h * steps, (t - t[0]) / count
    whole = bool((np.abs(counts - counts.round()) <= NEARLY).all()) and bool((np.abs(even - t) <= count).all())
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
    """Whether all of these rows are those before them."""
    return bool(((rows == before) | (np.isnan(rows) & np.isnan(before))).all())
