"""Numbers that a logger writes where a reading is missing, such as -999, 9999, 1e30 and 65535.

A mark repeats exactly, and lies farther from the readings than these from one another. A mechanism does not jump there
and back, again and again; only a sensor that wraps does, and its jumps all begin and end at the other end of its range.
A number that loggers write (`is_usual`) may stand in one place alone. Inputs jump, as pulses do: their marks have to be
such numbers.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# The largest numbers of 16 and 32 bits, with and without a sign, and the smallest.
ENDS = (2**15 - 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1)
# Files of weather and climate models are filled with 1e20 and 9.97e36, those of LabVIEW and Fortran with 1e30.
HUGE = 1e20
# Rows that a warning names.
MAX_ROWS = 3


def marks_of(
    x: np.ndarray,  # (N,) readings, NaN where one is blank
    together: np.ndarray,  # (N - 1,) bool: a row and the next are of one recording
    is_input: bool = False,
) -> list[float]:
    """The marks of missing readings in a column: its lowest value, its highest value, both or none."""
    known = np.flatnonzero(~np.isnan(x))
    if not len(known):
        return []
    # Blank rows do not part the readings beside them.
    part = np.concatenate([[0], np.cumsum(~together)])[known]
    x, pair = x[known], np.diff(part) == 0
    low, high = float(x.min()), float(x.max())
    # Numbers near the largest of float64 have infinite differences.
    with np.errstate(over="ignore"):
        return next((sorted(own) for own in ({low}, {high}, {low, high}) if _are_marks(x, pair, own, is_input)), [])


def _are_marks(x: np.ndarray, pair: np.ndarray, marks: set[float], is_input: bool) -> bool:
    """Whether all of these extreme values of x, (N,), are marks; `pair` as `together` of `marks_of`."""
    at = np.isin(x, list(marks))
    rest = x[~at]
    if not len(rest) or (is_input and not all(map(is_usual, marks))):
        return False
    steps = np.abs(np.diff(x))[pair & ~at[1:] & ~at[:-1]]
    jump, ends = pair & (at[1:] != at[:-1]), (float(rest.min()), float(rest.max()))
    # Fewer steps than jumps tell nothing of the motion.
    return len(steps) > int(jump.sum()) and all(_is_mark(x, jump, mark, ends, float(steps.max())) for mark in marks)


def _is_mark(x: np.ndarray, jump: np.ndarray, mark: float, ends: tuple[float, float], step: float) -> bool:
    """Whether a value is a mark beside readings between two `ends`, of which neighbours differ by up to a `step`.

    `jump` (N - 1,) bool: one of two rows is a mark, and the other is none.
    """
    (low, high), at = ends, x == mark
    there, back = jump & at[1:], jump & at[:-1]
    beside = np.concatenate([x[:-1][there], x[1:][back]])
    # Two steps: where a sensor wraps, the step may be longer than all others. Readings that go from end to end in
    # fewer steps may jump anywhere.
    wraps = bool((np.abs(beside - (low if mark > high else high)) <= 2 * step).all())
    far = max(low - mark, mark - high) > high - low
    again = min(int(there.sum()), int(back.sum())) > (0 if is_usual(mark) else 1)
    return int(at.sum()) > 1 and far and again and not wraps


def is_usual(value: float) -> bool:
    """Whether loggers write this number for a missing reading: nines, an end of whole numbers, or a huge number."""
    size = abs(value)
    return size in ENDS or size >= HUGE or (size >= 999 and set(f"{size:.15g}") <= {"9", "."})


def without_marks(
    values: np.ndarray,  # (N, k) numbers, the time first, NaN for a missing value
    labels: Sequence[str | int],  # (N,) recording of each row
    at: Sequence[int],  # (N,) number of each row in the file
    columns: Sequence[tuple[int, str, bool]],  # place among the k, name, whether an input
) -> tuple[np.ndarray, list[str]]:
    """The numbers with NaN for marks of missing readings, and a warning for each mark."""
    values, notes = values.copy(), []
    together = (values[1:, 0] > values[:-1, 0]) & (np.array(labels[1:]) == np.array(labels[:-1]))
    for k, name, is_input in columns:
        for mark in marks_of(values[:, k], together, is_input):
            rows = np.flatnonzero(values[:, k] == mark)
            values[rows, k] = np.nan
            some = ", ".join(str(at[row]) for row in rows[:MAX_ROWS]) + (", …" if len(rows) > MAX_ROWS else "")
            notes.append(
                f"warning: {name} is {mark:.15g} in {len(rows)} rows ({some}), farther from its other values than "
                "these from one another: it is taken for a mark of missing readings, as if the cells were blank"
            )
    return values, notes
