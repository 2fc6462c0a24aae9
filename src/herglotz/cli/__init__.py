"""The command line: one module a subcommand.

A user's mistake is one line on stderr and exit code 2; a failed verification is exit code 1; Ctrl-C is 130. Only the
subcommands that need PyTorch import it, so that help is immediate.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence

from herglotz.cli.parser import build_parser
from herglotz.errors import InputError

OK, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one subcommand.

    Parameters
    ----------
    argv
        Arguments without the program's name; left out, those of the process.

    Returns
    -------
    int
        The exit code: 0, 1 (a check failed), 2 (wrong input) or 130 (interrupted).
    """
    # Small matrices are fastest on one thread: on a busy machine a second thread waits for the first (9 times slower
    # was measured). PyTorch reads the variable when it is imported; a value that the user has set stays.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    try:
        arguments = build_parser().parse_args(argv)
        return int(arguments.run(arguments) or OK)
    except SystemExit as stop:  # argparse: help and version (0), usage errors (2)
        return stop.code if isinstance(stop.code, int) else OK
    except KeyboardInterrupt as interrupt:
        return _say(f"interrupted{interrupt}", INTERRUPTED)
    except BrokenPipeError:  # the reader of our output has left (`herglotz verify ... | head -1`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except (InputError, OSError) as error:
        return _say(f"error: {error}", WRONG_INPUT)


def _say(message: str, code: int) -> int:
    print("herglotz:", " ".join(message.split()), file=sys.stderr)
    return code


__all__ = ["main"]
