"""`python -m herglotz` and the command `herglotz`.

An interrupt while the command line itself is imported (0.1 s) ends the process quietly, as later ones do.
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

if __name__ == "__main__":
    sys.exit(main())
