"""The command line: one module a subcommand.

A user's mistake is one line on stderr (wrapped at a terminal) and exit code 2; a failed verification is exit code 1;
Ctrl-C and SIGTERM are 130; a fault of the package itself is 70, with a line that says how to report it. Only the
subcommands that need PyTorch import it, so that help is immediate.
"""

from __future__ import annotations

import os
import shlex
import signal
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

import herglotz
from herglotz.cli.common import complain
from herglotz.cli.parser import build_parser
from herglotz.errors import InputError

__all__ = ["main"]

# The last one is what shells report of a process that SIGINT has ended, 128 + 2.
OK, WRONG_INPUT, INTERNAL, INTERRUPTED = 0, 2, 70, 130
SIGNALS = (signal.SIGINT, signal.SIGTERM)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and return its exit code (see the head of this module).

    Without `argv` the arguments are those of the process, which then ends where it is interrupted.
    """
    try:
        with _orderly(), _one_thread():
            arguments = build_parser().parse_args(_asked(sys.argv[1:] if argv is None else argv))
            return int(arguments.run(arguments) or OK)
    except SystemExit as stop:  # argparse: help and version (0), usage errors (2)
        return stop.code if isinstance(stop.code, int) else OK
    except KeyboardInterrupt as interrupt:
        _say(f"interrupted{interrupt}", INTERRUPTED)
        return INTERRUPTED if argv is not None else _leave()
    except BrokenPipeError:  # the reader of our output has left (`herglotz verify ... | head -1`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except (InputError, OSError) as error:
        return _say(f"error: {error}", WRONG_INPUT)
    except Exception as error:
        if _no_memory(error):
            return _say("error: out of memory; use fewer samples or a machine with more", WRONG_INPUT)
        return _say(_internal(error, argv), INTERNAL)


def _asked(argv: Sequence[str]) -> Sequence[str]:
    """Arguments, where `herglotz` alone and `herglotz help COMMAND` ask for help."""
    return [*argv[1:], "--help"] if not argv or argv[0] == "help" else argv


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one thread inside, unless the user has set `OMP_NUM_THREADS`; the environment is given back.

    Small matrices are fastest on one thread: on a busy machine a second thread waits for the first (9 times slower was
    measured). PyTorch reads the variable when it is imported, and never again.
    """
    if "torch" in sys.modules:  # a program that calls `main`
        from herglotz.threads import one_thread

        with one_thread():
            yield
        return
    chosen = "OMP_NUM_THREADS" in os.environ
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        yield
    finally:
        if not chosen:  # `one_thread` would take it for the user's choice
            os.environ.pop("OMP_NUM_THREADS", None)


def _no_memory(error: Exception) -> bool:
    """Whether Python or torch, which has a word of its own for each device, was refused memory."""
    words = ("can't allocate memory", "out of memory", "std::bad_alloc")
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(x in str(error) for x in words))


def _internal(error: Exception, argv: Sequence[str] | None) -> str:
    """What happened where, for the people who mend it; the whole traceback where HERGLOTZ_TRACEBACK is set."""
    if os.environ.get("HERGLOTZ_TRACEBACK"):
        traceback.print_exception(error)
    frame = traceback.extract_tb(error.__traceback__)[-1]
    command = shlex.join(["herglotz", *(sys.argv[1:] if argv is None else argv)])
    what = " ".join(str(error).split())[:200]
    return (
        f"internal error: {type(error).__name__}: {what} ({Path(frame.filename).name}:{frame.lineno}). This is a fault "
        f"of herglotz {herglotz.__version__}, not yours: please report it with this line, the command `{command}`, and "
        "what HERGLOTZ_TRACEBACK=1 in front of it prints"
    )


def _say(message: str, code: int) -> int:
    complain(message)
    return code


def _leave() -> int:
    """End the process without Python's own end, in which threads of torch were seen to abort (exit code 134)."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # its reader may have left
            stream.flush()
    os._exit(INTERRUPTED)


def _importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported: torch and numpy make other errors of an interrupt, or swallow it."""
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


@contextmanager
def _orderly() -> Iterator[None]:
    """Raise `KeyboardInterrupt` at the first signal, leave at the second; the handlers before come back at the end."""
    if threading.current_thread() is not threading.main_thread():  # signals are the main thread's
        yield
        return
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True
        if _importing(frame):
            leave(number, frame)
        for one in SIGNALS:
            signal.signal(one, leave)
        raise KeyboardInterrupt

    def leave(_number: int, _frame: object) -> None:
        os.write(2, b"herglotz: interrupted\n")
        os._exit(INTERRUPTED)  # files are written whole or not at all, and locks end with their process

    before = {one: signal.signal(one, stop) for one in SIGNALS}
    try:
        yield
    except Exception as error:
        if stopped:  # compiled parts of matplotlib make another error of an interrupt
            raise KeyboardInterrupt from error
        raise
    finally:
        if not stopped:  # else the process is about to end, and a signal on the way would print a traceback
            for one, handler in before.items():
                signal.signal(one, handler)
