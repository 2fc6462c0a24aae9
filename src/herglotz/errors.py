"""The one exception a user's mistake raises; the command line turns it into one line and exit code 2."""


class InputError(ValueError):
    """Something the user gave is wrong. The message names what, where, the value and the remedy."""


def refuse(wrong: dict[str, object]) -> None:
    """Raise `InputError` with the first of these messages whose condition holds."""
    for message, holds in wrong.items():
        if holds:
            raise InputError(message)
