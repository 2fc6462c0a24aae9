"""Messages while a result is made: how columns were read, how far a fit is."""

import sys


def tell(text: str) -> None:
    """Print on stderr; in a notebook on stdout, as notebooks show stderr on red ground, as if something had failed."""
    print(text, file=sys.stdout if "ipykernel" in sys.modules else sys.stderr, flush=True)
