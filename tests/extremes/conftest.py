"""Nothing may hang: every test here ends by the clock on the wall, in Python or in C."""

import faulthandler
import os
import signal
import sys
from contextlib import contextmanager

import pytest

SECONDS = {False: 60.0, True: 600.0}  # by whether a test is marked slow
GRACE = 30.0  # a loop in C hears no signal: so long after it the whole process ends


@contextmanager
def _bounded(seconds, grace=GRACE, screen=None):
    """Raise `TimeoutError` in the main thread after so many seconds (where the system has an interval timer).

    What does not come back to Python even then ends the process with the line of each thread on `screen`.
    """

    def stop(*_):
        raise TimeoutError(f"still running after {seconds:g} s")

    faulthandler.dump_traceback_later(seconds + grace, exit=True, file=screen or sys.__stderr__ or 2)
    before = signal.signal(signal.SIGALRM, stop) if hasattr(signal, "setitimer") else None
    try:
        if before is not None:
            signal.setitimer(signal.ITIMER_REAL, seconds)
        yield
    finally:
        if before is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
        faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="session")
def _screen(request):
    """Standard error itself: what pytest captures is lost with the process."""
    with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        screen = os.fdopen(os.dup(2), "w")
    with screen:
        yield screen


@pytest.fixture(autouse=True)
def _wall_clock(request, _screen):
    with _bounded(SECONDS[request.node.get_closest_marker("slow") is not None], screen=_screen):
        yield


@pytest.fixture
def bounded():
    return _bounded
