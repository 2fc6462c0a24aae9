"""The command line: one module a subcommand.

Exit codes: 1 for a failed verification; 2 for a mistake of the user, with one line on stderr (wrapped at a terminal); 3
for a fit that does not follow its data; 70 for a fault of the package, with a line that says how to report the fault;
130 after Ctrl-C or SIGTERM. A subcommand imports PyTorch when it runs, so that help needs no PyTorch.
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

# Shells report 128 + 2 for a process that SIGINT has ended.
OK, WRONG_INPUT, INTERNAL, INTERRUPTED = 0, 2, 70, 130
SIGNALS = (signal.SIGINT, signal.SIGTERM)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand and return its exit code (see the head of this module).

    Without `argv` the arguments are those of the process, and an interrupt ends the process.
    """
    try:
        with _interruptible(), _one_thread():
            arguments = build_parser().parse_args(_or_help(sys.argv[1:] if argv is None else argv))
            return int(arguments.run(arguments) or OK)
    # argparse raises SystemExit after help and version (0), and after a usage error (2).
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else OK
    except KeyboardInterrupt as interrupt:
        _say(f"interrupted{interrupt}", INTERRUPTED)
        return INTERRUPTED if argv is not None else _leave()
    # The reader of the output has closed the pipe: `herglotz verify ... | head -1`.
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except (InputError, OSError) as error:
        return _say(f"error: {error}", WRONG_INPUT)
    except Exception as error:
        if _out_of_memory(error):
            return _say("error: out of memory; use fewer samples or a machine with more", WRONG_INPUT)
        return _say(_internal(error, argv), INTERNAL)


def _or_help(argv: Sequence[str]) -> Sequence[str]:
    """The arguments, with --help for `herglotz` alone and for `herglotz help COMMAND`."""
    return [*argv[1:], "--help"] if not argv or argv[0] == "help" else argv


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one thread inside, unless the user has set `OMP_NUM_THREADS`; restore the environment.

    Small matrices are fastest on one thread (`herglotz.threads`). PyTorch reads the variable when it is imported, and
    never again.
    """
    # A program that calls `main` may have imported PyTorch before.
    if "torch" in sys.modules:
        from herglotz.threads import one_thread

        with one_thread():
            yield
        return
    chosen = "OMP_NUM_THREADS" in os.environ
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        yield
    finally:
        # `one_thread` takes the variable for the user's choice.
        if not chosen:
            os.environ.pop("OMP_NUM_THREADS", None)


def _out_of_memory(error: Exception) -> bool:
    """True if Python or torch was refused memory; torch's message depends on the device."""
    words = ("can't allocate memory", "out of memory", "std::bad_alloc")
    return isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and any(x in str(error) for x in words))


def _internal(error: Exception, argv: Sequence[str] | None) -> str:
    """The message on a fault of the package; if HERGLOTZ_TRACEBACK is set, the traceback is printed as well."""
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
    """End the process at once: when Python ends after an interrupt, threads of torch may abort (exit code 134)."""
    for stream in (sys.stdout, sys.stderr):
        # The reader of the stream may have closed the pipe.
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(INTERRUPTED)


def _importing(frame: FrameType | None) -> bool:
    """True while a module is imported: torch and numpy turn an interrupt into another error, or suppress it."""
    while frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib"):
        frame = frame.f_back
    return frame is not None


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise `KeyboardInterrupt` at the first signal, end the process at the second; restore the handlers at the end."""
    # Python handles signals in the main thread alone.
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True
        if _importing(frame):
            leave(number, frame)
        for each in SIGNALS:
            signal.signal(each, leave)
        raise KeyboardInterrupt

    def leave(_number: int, _frame: object) -> None:
        os.write(2, b"herglotz: interrupted\n")
        # Nothing is left half done: files are written whole or not at all, and a lock ends with its process.
        os._exit(INTERRUPTED)

    before = {each: signal.signal(each, stop) for each in SIGNALS}
    try:
        yield
    except Exception as error:
        # Compiled parts of matplotlib turn an interrupt into another error.
        if stopped:
            raise KeyboardInterrupt from error
        raise
    finally:
        # After an interrupt the process ends, and another signal must not print a traceback.
        if not stopped:
            for each, handler in before.items():
                signal.signal(each, handler)
