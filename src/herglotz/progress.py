"""Progress bars."""

from __future__ import annotations

from tqdm import tqdm


class ProgressBar(tqdm):
    """tqdm's bar without its monitor thread.

    The thread draws bars that have not moved for ten seconds. Where it holds stderr while Python ends, as after Ctrl-C,
    Python aborts with signal 6 in place of the command's exit code.
    """

    monitor_interval = 0
