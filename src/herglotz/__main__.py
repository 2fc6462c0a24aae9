"""`python -m herglotz` and the command `herglotz`.

An interrupt while the command line is imported (0.1 s) ends the process without a traceback, as a later interrupt
does. An interrupt while Python ends (0.4 s with torch) does not change the exit code.
"""

import os
import signal
import sys


def _leave(_number: int, _frame: object) -> None:
    os.write(2, b"herglotz: interrupted\n")
    os._exit(130)


# A program that imports this module keeps its own handlers.
if __name__ == "__main__" or os.path.basename(sys.argv[0]).startswith("herglotz"):
    signal.signal(signal.SIGINT, _leave)
    signal.signal(signal.SIGTERM, _leave)

from herglotz.cli import main  # noqa: E402  (after the handlers)


def command() -> int:
    """Run the subcommand of the process's arguments; return the exit code."""
    code = main()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return code


if __name__ == "__main__":
    sys.exit(command())
