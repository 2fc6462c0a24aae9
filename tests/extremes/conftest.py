"""Nothing may hang: processor time bounds every test here; the clock on the wall ends what blocks or loops in C."""

import faulthandler
import os
import signal
import sys
from contextlib import contextmanager

import pytest

SECONDS = {False: 60.0, True: 600.0}  # of processor time, by whether a test is marked slow
# A loop in C hears no signal, and what blocks takes no processor time: the process ends after so many times the bound
# on the wall. A machine would have to be this many times too busy for that clock to decide a test.
LAST_RESORT = 20.0


@contextmanager
def _bounded(seconds, wall=None, screen=None):
    """Raise `TimeoutError` in the main thread after so many seconds of processor time (where the system has the timer).

    What does not come back to Python ends the process after `wall` seconds, with the line of each thread on `screen`.
    """

    def stop(*_):
        raise TimeoutError(f"still running after {seconds:g} s of processor time")

    faulthandler.dump_traceback_later(wall or LAST_RESORT * seconds, exit=True, file=screen or sys.__stderr__ or 2)
    before = signal.signal(signal.SIGPROF, stop) if hasattr(signal, "setitimer") else None
    try:
        if before is not None:
            signal.setitimer(signal.ITIMER_PROF, seconds)
        yield
    finally:
        if before is not None:
            signal.setitimer(signal.ITIMER_PROF, 0)
            signal.signal(signal.SIGPROF, before)
        faulthandler.cancel_dump_traceback_later()


@pytest.fixture(scope="session")
def _screen(request):
    """Standard error itself: what pytest captures is lost with the process."""
    with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
        screen = os.fdopen(os.dup(2), "w")
    with screen:
        yield screen


@pytest.fixture(autouse=True)
def _clock(request, _screen):
    with _bounded(SECONDS[request.node.get_closest_marker("slow") is not None], screen=_screen):
        yield


@pytest.fixture
def bounded():
    return _bounded
