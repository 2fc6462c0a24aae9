"""Messages while a command or a fit runs: how columns were read, how far a fit has come."""

import sys


def tell(text: str) -> None:
    """Print on stderr; in a notebook on stdout, because notebooks show stderr on a red background, like a failure."""
    print(text, file=sys.stdout if "ipykernel" in sys.modules else sys.stderr, flush=True)
