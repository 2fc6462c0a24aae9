"""Progress bars."""

from __future__ import annotations

import time

from tqdm import tqdm

AGAIN = 0.2  # seconds between two drawings of a search, whose time goes on
SEARCH = "{desc}{elapsed}"
STAGE = "{desc}{percentage:3.0f}%|{bar}| {elapsed}, at most {remaining} left{postfix}"


class ProgressBar(tqdm):
    """tqdm's bar without its monitor thread.

    The thread draws bars that have not moved for ten seconds. Where it holds stderr while Python ends, as after Ctrl-C,
    Python aborts with signal 6 in place of the command's exit code.
    """

    monitor_interval = 0
    searching: ProgressBar | None = None  # the bar of the search under way, which `beat` draws

    def search(self, name: str) -> None:
        """Show how long a search, whose end nobody knows, has taken; `beat` draws the time."""
        self.bar_format, self.drawn = SEARCH, time.monotonic()
        if not self.disable:  # a search makes fits of its own, whose bars are not drawn
            ProgressBar.searching = self
        self.set_description(name)

    def stage(self, name: str, total: int) -> None:
        """Show how far a stage of so many iterations is, most of which end before their bound."""
        self.bar_format = STAGE
        self._searched()
        self.total = self.n + total
        self.last_print_t = time.time()  # what was searched for before tells nothing of an iteration's time
        self.set_description(name)

    def close(self) -> None:
        """See tqdm."""
        self._searched()
        super().close()

    def _searched(self) -> None:
        if ProgressBar.searching is self:
            ProgressBar.searching = None


def beat() -> None:
    """Draw the time of the search under way, if any."""
    bar = ProgressBar.searching
    if bar is not None and time.monotonic() - bar.drawn > AGAIN:
        bar.drawn = time.monotonic()
        bar.refresh()
