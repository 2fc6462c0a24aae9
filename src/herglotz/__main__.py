"""`python -m herglotz`: the same as the command `herglotz`."""

import sys

from herglotz.cli import main

if __name__ == "__main__":
    sys.exit(main())
