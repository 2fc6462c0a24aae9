"""`python -m herglotz` and the command `herglotz`.

An interrupt while the command line itself is imported (0.1 s) ends the process quietly, as later ones do. One that
comes when all is done, while Python ends (0.4 s with torch), leaves the exit code as it is.
"""

import os
import signal
import sys


def _leave(_number: int, _frame: object) -> None:
    os.write(2, b"herglotz: interrupted\n")
    os._exit(130)


if __name__ == "__main__" or os.path.basename(sys.argv[0]).startswith("herglotz"):  # no program that imports this
    signal.signal(signal.SIGINT, _leave)
    signal.signal(signal.SIGTERM, _leave)

from herglotz.cli import main  # noqa: E402  (after the handlers)


def command() -> int:
    """Run the subcommand that the process was started with; the process is to end with what is returned."""
    code = main()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    return code


if __name__ == "__main__":
    sys.exit(command())
