"""Inputs that are properties of recordings, as a mass is: the same throughout each recording, and not in all.

A property acts on the law as it likes: a mass by its inverse. As an input it adds a force. A recording whose value no
other recording has may be missed for that, and is not said to be of something else.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from herglotz.data import Trajectories


def properties(data: Trajectories) -> dict[str, Tensor]:
    """The inputs that are the same throughout each recording and differ between recordings: their values, (B,)."""
    recorded = {name for name, role, _ in data.columns if role == "input"}
    found = {}
    for name, u in zip([name for name, _ in data.input_labels], [] if data.u is None else data.u.T, strict=True):
        values = u[list(data.offsets)]
        constant = bool((u == values[data.trajectory]).all())
        if constant and bool((values != values[0]).any()) and (name in recorded or not recorded):
            found[name] = values
    return found


def own_properties(data: Trajectories, recording: int) -> tuple[str, ...]:
    """The properties whose value no other recording has."""
    return tuple(name for name, x in properties(data).items() if int((x == x[recording]).sum()) == 1)


def by_property(names: Sequence[str]) -> str:
    """The words for a recording that alone has its values of these properties."""
    return f"alone has its {' and '.join(names)}, on which the law may depend otherwise than by a force"


def inverse(names: Sequence[str]) -> str:
    """What to try where the law may depend on these properties."""
    columns = " and ".join(f"a column 1/({name})" if " " in name else f"a column 1/{name}" for name in names)
    place = "its place" if len(names) == 1 else "their place"
    return f"{columns} in {place} (--inputs), as a mass acts by its inverse, or a fit of each recording"
