"""Small parts of every command: tables, signals, what is said of a fault of the package's own."""

import signal

import pytest

from herglotz.cli import _internal
from herglotz.cli.common import print_table
from herglotz.cli.interrupts import SIGNALS, orderly


def test_a_long_value_goes_on_below_itself(capsys):  # fails if its second line begins under the names
    print_table([("a", "short"), ("name", " ".join(["word"] * 20))])
    first, second, third = capsys.readouterr().out.splitlines()
    assert first == "  a     short"
    assert second.startswith("  name  word")
    assert third.startswith(" " * 8 + "word")


def test_an_internal_error_names_the_innermost_line():  # fails if another frame of the traceback is named
    def inner():
        raise ZeroDivisionError("two\nlines")

    def outer():
        inner()

    with pytest.raises(ZeroDivisionError) as caught:
        outer()
    line = inner.__code__.co_firstlineno + 1
    assert f"ZeroDivisionError: two lines (test_parts.py:{line})" in _internal(caught.value, ["fit", "a b"])
    assert "the command `herglotz fit 'a b'`" in _internal(caught.value, ["fit", "a b"])


def test_a_program_that_calls_a_command_keeps_its_signals():
    # fails if the handlers of a command outlive one that ended, or come back while an interrupted one ends
    before = [signal.getsignal(one) for one in SIGNALS]
    try:
        with orderly():
            assert all(signal.getsignal(one) not in before for one in SIGNALS)
        assert [signal.getsignal(one) for one in SIGNALS] == before
        with pytest.raises(KeyboardInterrupt), orderly():
            signal.raise_signal(signal.SIGTERM)
        assert all(signal.getsignal(one) not in before for one in SIGNALS)
    finally:
        for one, handler in zip(SIGNALS, before, strict=True):
            signal.signal(one, handler)
