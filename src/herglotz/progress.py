"""Progress bars."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

AGAIN = 0.2  # seconds between two drawings of a bar
# How much of a fit's time is over where a part of it begins and ends: medians of 19 systems of `zoo.py --draw 9301`.
LOOKING, FINDING, STAGES = (0.0, 0.05), (0.05, 0.65), (0.66, 0.98)
FIRST_TERMS, MORE_TERMS, FEWER_TERMS = (0.0, 0.65), (0.65, 0.7), (0.7, 1.0)  # of FINDING


class ProgressBar(tqdm):
    """tqdm's bar without its monitor thread.

    The thread draws bars that have not moved for ten seconds. If the thread holds stderr while Python ends, as after
    Ctrl-C, Python aborts with signal 6 in place of the command's exit code.
    """

    monitor_interval = 0


class FitBar(ProgressBar):
    """A bar over a whole fit, with an estimate of the time left.

    The number of parts of a fit is not known before the end. The time left follows from the share of the time that
    typical fits have behind them where the part under way begins and ends, and within a stage from the time of the
    iterations: as many again as were done, or the rest of the bound.
    """

    under_way: FitBar | None = None  # the bar that `beat` draws

    def __init__(self, **options: Any):
        self.enclosing = self.span = (0.0, 1.0)
        self.expected = self.began = self.drawn_at = self.shown = 0.0  # expected: s of the whole fit
        self.iteration = self.most = 0
        self.start = time.time()
        form = "{desc}{percentage:3.0f}%|{bar}| {elapsed}, about {left} left{postfix}"
        super().__init__(total=1, bar_format=form, leave=False, dynamic_ncols=True, **options)
        if not self.disable:  # the fits inside a search have silent bars
            FitBar.under_way = self

    def part(self, span: tuple[float, float], name: str = "", most: int = 0) -> None:
        """Go over to what typical fits need this span of the present part's time for: `most` iterations, if known."""
        if self.disable:
            return
        low, high = self.enclosing
        first, last = (low + x * (high - low) for x in span)
        before = self.span
        self.span = max(first, before[0]), max(last, before[0])
        self.began, self.iteration, self.most = time.time(), 0, most
        if before[0] > 0 and self.span[0] > before[0]:  # where terms were not searched for, shares tell nothing
            self.expected = (self.began - self.start) / first
        if name:
            self.set_description(name, refresh=False)
            self.set_postfix_str("", refresh=False)
        self.draw()

    def iterate(self) -> None:
        """Count an iteration of the part under way."""
        self.iteration += 1
        self.beat()

    @property
    def left(self) -> float:
        """Seconds that the fit may still take."""
        now, (first, last) = time.time(), self.span
        passed = now - self.start
        share = last if self.expected else (first + last) / 2
        by_parts = max(self.expected - passed, passed * (1 - share) / share)
        if not self.iteration:
            return by_parts if first > 0 else math.inf
        each = (now - self.began) / self.iteration
        return max(by_parts, each * min(self.iteration, self.most - self.iteration))

    @property
    def format_dict(self) -> dict[str, Any]:
        """See tqdm."""
        found = super().format_dict
        passed, left = found["elapsed"], self.left
        self.shown = max(self.shown, passed / (passed + left) if passed else 0.0)  # a bar does not go back
        known = tqdm.format_interval(left) if math.isfinite(left) else "?"
        return {**found, "n": self.shown, "total": 1, "left": known}

    def draw(self) -> None:
        """Draw the present bar."""
        self.drawn_at = time.monotonic()
        self.refresh()

    def beat(self) -> None:
        """Draw the bar if the last drawing is a while ago."""
        if not self.disable and time.monotonic() - self.drawn_at > AGAIN:
            self.draw()

    def close(self) -> None:
        """See tqdm."""
        if FitBar.under_way is self:
            FitBar.under_way = None
        super().close()


def beat() -> None:
    """Draw the time of the fit under way, if any."""
    if FitBar.under_way is not None:
        FitBar.under_way.beat()


def part(span: tuple[float, float]) -> None:
    """Tell the bar of the fit under way, if any, which span of the present part's time begins."""
    if FitBar.under_way is not None:
        FitBar.under_way.part(span)


@contextmanager
def inside() -> Iterator[None]:
    """Parts that begin in here are of the part under way."""
    bar = FitBar.under_way
    if bar is None:
        yield
        return
    before, bar.enclosing = bar.enclosing, bar.span
    try:
        yield
    finally:
        bar.enclosing = before
