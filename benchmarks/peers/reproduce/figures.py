"""A figure of a source, and what counts as agreement with it.

Fixed before the runs at the settings that are here:

- The source gives a spread (±, or several runs): the range of our seeds meets it.
- Its number was read off a logarithmic plot: the median of our seeds lies within half a decade.
- It gives the error that its method attains: our median is at most twice as large. Less is no disagreement.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """What a source states, and the interval that decides.

    Parameters
    ----------
    source
        Where, and the number with its spread.
    low, high
        The interval.
    by_range
        Whether the range of our seeds has to meet the interval; else the median has to lie in it.
    """

    source: str
    low: float
    high: float
    by_range: bool = True

    def agrees(self, here: Sequence[float]) -> bool:
        """Whether what was measured here, a value a seed, agrees."""
        least, most = (min(here), max(here)) if self.by_range else (statistics.median(here),) * 2
        return least <= self.high and most >= self.low

    @property
    def rule(self) -> str:
        """The interval in words."""
        what = "range" if self.by_range else "median"
        if self.low == 0.0:
            return f"{what} at most {self.high:.2g}"
        return f"{what} {'meets' if self.by_range else 'in'} {self.low:.2g} – {self.high:.2g}"


def spread(value: float, plus_minus: float) -> tuple[float, float]:
    """The interval of a number with its ±."""
    return value - plus_minus, value + plus_minus


def read_off(source: str, value: float) -> Figure:
    """One number read off a logarithmic plot: half a decade."""
    return Figure(source, value / math.sqrt(10), value * math.sqrt(10), by_range=False)


def at_most_twice(source: str, value: float) -> Figure:
    """An error that the source's method attains."""
    return Figure(source, 0.0, 2 * value, by_range=False)
