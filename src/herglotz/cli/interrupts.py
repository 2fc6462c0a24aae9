"""Ctrl-C and SIGTERM: the first ends a command in good order, the second at once; neither prints a traceback."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

CODE = 130  # what shells report of a process that SIGINT has ended, 128 + 2
SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def orderly() -> Iterator[None]:
    """Raise `KeyboardInterrupt` at the first signal and leave at the second; the handlers before come back after it."""
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's
        yield
        return
    stopped = False

    def stop(_number: int, _frame: object) -> None:
        nonlocal stopped
        stopped = True
        for one in SIGNALS:
            signal.signal(one, leave)
        raise KeyboardInterrupt

    def leave(_number: int, _frame: object) -> None:
        os.write(2, b"herglotz: interrupted\n")
        os._exit(CODE)  # files are written whole or not at all, and locks end with their process

    before = {one: signal.signal(one, stop) for one in SIGNALS}
    try:
        yield
    finally:
        if not stopped:  # else the process is about to end, and a signal on the way would print a traceback
            for one, handler in before.items():
                signal.signal(one, handler)
