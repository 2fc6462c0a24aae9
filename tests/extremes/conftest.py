"""Nothing may hang: every test here ends by the clock on the wall."""

import signal
from contextlib import contextmanager

import pytest

SECONDS = {False: 60.0, True: 600.0}  # by whether a test is marked slow


@contextmanager
def _bounded(seconds):
    """Raise `TimeoutError` in the main thread after so many seconds (where the system has an interval timer)."""
    if not hasattr(signal, "setitimer"):
        yield
        return

    def stop(*_):
        raise TimeoutError(f"still running after {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(autouse=True)
def _wall_clock(request):
    with _bounded(SECONDS[request.node.get_closest_marker("slow") is not None]):
        yield


@pytest.fixture
def bounded():
    return _bounded
