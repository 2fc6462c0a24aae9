"""The one exception a user's mistake raises; the command line turns it into one line and exit code 2."""

from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path


class InputError(ValueError):
    """Something the user gave is wrong. The message names what, where, the value and the remedy."""


def refuse(wrong: dict[str, object]) -> None:
    """Raise `InputError` with the first of these messages whose condition holds."""
    for message, holds in wrong.items():
        if holds:
            raise InputError(message)


def check_coordinates(where: str, option: str, wanted: Iterable[str], names: Sequence[str]) -> None:
    """Raise InputError if an option names a coordinate that is none of `names`."""
    for name in wanted:
        if name not in names:
            raise InputError(f"{where or 'data'}: {option} names {name!r}, but the coordinates are {', '.join(names)}")


def check_start(q0: bool, v0: bool, p0: bool, dash: str = "") -> None:
    """Raise unless a start is given whole, a position with either a velocity or a momentum, or not at all."""
    q, v, p = (f"{dash}{name}" for name in ("q0", "v0", "p0"))
    refuse({
        f"{v} and {p} both say how fast the start is; leave one out": v0 and p0,
        f"{q} and {v} (or {p}, the momentum) go together; give both, or neither to start from the last fitted state":
            q0 != (v0 or p0),
    })  # fmt: skip


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """The known word that this one resembles, as the end of a message; empty where it resembles none."""
    near = get_close_matches(word, list(known), n=1, cutoff=0.65)
    return f"; did you mean {near[0]}?" if near else ""


def no_such_file(path: Path) -> str:
    """The message on a missing file, with the file of a similar name in the same folder."""
    try:
        beside = [file.name for file in path.parent.iterdir()]
    except OSError:
        beside = []
    return f"{path}: there is no such file; check the name and the folder{did_you_mean(path.name, beside)}"
