"""`InputError`, which every mistake of a user raises, and messages while a command or a fit runs.

The command line prints one line for an error, and ends with exit code 2.
"""

import sys
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from numbers import Integral
from pathlib import Path


class InputError(ValueError):
    """An input of the user is wrong. The message names the place, the value and the remedy."""


def refuse(wrong: dict[str, object]) -> None:
    """Raise `InputError` with the first message whose condition is true; `wrong` is message → condition."""
    for message, holds in wrong.items():
        if holds:
            raise InputError(message)


def check_whole(least: int, **counts: object) -> None:
    """Raise InputError for the first count, by its name, that is no whole number of at least `least`."""
    for name, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, Integral) or count < least:
            raise InputError(f"{name} must be a whole number >= {least}, got {count!r}")


def check_coordinates(where: str, option: str, wanted: Iterable[str], names: Sequence[str]) -> None:
    """Raise InputError if an option names an unknown coordinate; `names` are the known ones."""
    for name in wanted:
        if name not in names:
            raise InputError(f"{where or 'data'}: {option} names {name!r}, but the coordinates are {', '.join(names)}")


def check_start(q0: bool, v0: bool, p0: bool, dash: str = "") -> None:
    """Raise unless a start is complete, a position with either a velocity or a momentum, or absent."""
    q, v, p = (f"{dash}{name}" for name in ("q0", "v0", "p0"))
    refuse({
        f"{v} and {p} both say how fast the start is; leave one out": v0 and p0,
        f"{q} and {v} (or {p}, the momentum) go together; give both, or neither to start from the last fitted state":
            q0 != (v0 or p0),
    })  # fmt: skip


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The end of a message, "; did you mean WORD?", with the known word that is most similar; empty if none is."""
    near = get_close_matches(word, list(known), n=1, cutoff=0.65)
    return f"; did you mean {near[0]}?" if near else ""


def no_such_file(path: Path) -> str:
    """The message on a missing file, with a similar name in the same folder if there is one."""
    try:
        beside = [file.name for file in path.parent.iterdir()]
    except OSError:
        beside = []
    return f"{path}: there is no such file; check the name and the folder{did_you_mean(path.name, beside)}"


def tell(text: str) -> None:
    """Print on stderr; in a notebook on stdout, because notebooks show stderr on a red background, like a failure."""
    print(text, file=sys.stdout if "ipykernel" in sys.modules else sys.stderr, flush=True)
