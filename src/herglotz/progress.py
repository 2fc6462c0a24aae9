"""Progress bars, and the time that a fit may still take."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

# A bar that is redrawn more often takes time from the fit.
REDRAW_SECONDS = 0.2
# Share of a fit's time that has passed when a part begins and when it ends: medians over 19 systems of `zoo.py --draw
# 9301`. The second line has shares of FINDING.
LOOKING, FINDING, STAGES = (0.0, 0.05), (0.05, 0.65), (0.66, 0.98)
FIRST_TERMS, MORE_TERMS = (0.0, 0.65), (0.65, 1.0)


class ProgressBar(tqdm):
    """tqdm's bar without its monitor thread.

    The thread redraws bars that have not moved for ten seconds. If the thread holds stderr while Python ends, as after
    Ctrl-C, Python aborts with signal 6 instead of the command's exit code.
    """

    monitor_interval = 0


class FitBar(ProgressBar):
    """A bar over a whole fit, with an estimate of the time left.

    The number of parts of a fit is not known before the end. The time left is estimated from the shares of the time
    that have passed in typical fits when the current part begins and ends. Within a stage the estimate assumes as many
    more iterations as were done, or the rest of the bound.
    """

    # The bar of the fit under way, which `beat` draws.
    under_way: FitBar | None = None

    def __init__(self, **options: Any):
        self.enclosing = self.span = (0.0, 1.0)
        # `expected`: seconds of the whole fit; 0 before an estimate is known.
        self.expected = self.began = self.drawn_at = self.shown = 0.0
        self.iteration = self.most = 0
        self.start = time.time()
        form = "{desc}{percentage:3.0f}%|{bar}| {elapsed}, about {left} left{postfix}"
        super().__init__(total=1, bar_format=form, leave=False, dynamic_ncols=True, **options)
        # Bars of fits inside a search are disabled.
        if not self.disable:
            FitBar.under_way = self

    def part(self, span: tuple[float, float], name: str = "", most: int = 0) -> None:
        """Begin a part that takes this span of the enclosing part's time in typical fits; at most `most` iterations."""
        if self.disable:
            return
        low, high = self.enclosing
        first, last = (low + x * (high - low) for x in span)
        before = self.span
        self.span = max(first, before[0]), max(last, before[0])
        self.began, self.iteration, self.most = time.time(), 0, most
        # A fit without a search for terms has other shares: no time is expected from them.
        if before[0] > 0 and self.span[0] > before[0]:
            self.expected = (self.began - self.start) / first
        if name:
            self.set_description(name, refresh=False)
            self.set_postfix_str("", refresh=False)
        self.draw()

    def iterate(self) -> None:
        """Count an iteration of the current part."""
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
        """The numbers of tqdm, with `n` as the share of the time that has passed, and the time left."""
        found = super().format_dict
        passed, left = found["elapsed"], self.left
        # The bar never goes back.
        self.shown = max(self.shown, passed / (passed + left) if passed else 0.0)
        known = tqdm.format_interval(left) if math.isfinite(left) else "?"
        return {**found, "n": self.shown, "total": 1, "left": known}

    def draw(self) -> None:
        """Draw the bar."""
        self.drawn_at = time.monotonic()
        self.refresh()

    def beat(self) -> None:
        """Draw the bar if the last drawing is more than `REDRAW_SECONDS` ago."""
        if not self.disable and time.monotonic() - self.drawn_at > REDRAW_SECONDS:
            self.draw()

    def close(self) -> None:
        """Remove the bar; no fit is under way any more."""
        if FitBar.under_way is self:
            FitBar.under_way = None
        super().close()


def beat() -> None:
    """Update the bar of the fit under way, if there is one."""
    if FitBar.under_way is not None:
        FitBar.under_way.beat()


def part(span: tuple[float, float]) -> None:
    """Begin a part in the bar of the fit under way, if there is one; see `FitBar.part`."""
    if FitBar.under_way is not None:
        FitBar.under_way.part(span)


@contextmanager
def inside() -> Iterator[None]:
    """Inside, spans of parts are shares of the current part."""
    bar = FitBar.under_way
    if bar is None:
        yield
        return
    before, bar.enclosing = bar.enclosing, bar.span
    try:
        yield
    finally:
        bar.enclosing = before
