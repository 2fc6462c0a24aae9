"""The role of each csv column: time, trajectory, coordinate, action, momentum, input, or left aside."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from herglotz.data.rows import quote
from herglotz.errors import InputError

HEADER_CELL = re.compile(r"([^\[\]]+?)\s*(?:\[([^\[\]]*)\])?")
TIME, TRAJECTORY = ("t", "time"), ("trajectory", "trial")
ACTION, MOMENTUM, INPUT = re.compile("s"), re.compile("p|p_.*"), re.compile("u|u_.*|torque")
VELOCITY = re.compile(r"v|velocity|.*_dot")  # left aside: a logged velocity is usually filtered


@dataclass(frozen=True)
class Columns:
    """Column numbers (from 0) by what they mean."""

    names: tuple[str, ...]  # of all columns, as the header spells them
    units: tuple[str, ...]  # of all columns, "" where the header gives none
    time: int
    q: tuple[int, ...]
    trajectory: int | None = None
    s: int | None = None
    p: tuple[int, ...] = ()
    u: tuple[int, ...] = ()

    @property
    def numeric(self) -> tuple[int, ...]:
        """Columns whose cells are parsed as numbers."""
        return (self.time, *self.q, *(() if self.s is None else (self.s,)), *self.p, *self.u)


def assign(
    cells: Sequence[str],  # the header's cells, `name` or `name[unit]`
    where: str,  # begins every message: file and row
    time: str | None = None,  # name of the time column, if neither t nor time
    coordinates: Sequence[str] | None = None,  # names of the coordinates, if not "all others"
) -> Columns:
    """Give every column of a header its role.

    Raises
    ------
    InputError
        If a cell cannot be read, a name comes twice, time or all coordinates are missing, or a named column is absent.
    """
    names, units = _parse(cells, where)
    # "Time" means time, but a single "V" may be a volume.
    key = {name: name.casefold() if len(name) > 1 else name for name in names}
    for asked in (() if time is None else (time,)) + tuple(coordinates or ()):
        if asked not in names:
            raise InputError(f"{where}: there is no column {quote(asked)}; the columns are {', '.join(names)}")
    clock = [time] if time is not None else [x for x in names if key[x] in TIME and x not in (coordinates or ())]
    if len(clock) != 1:
        found = f"two time columns, {' and '.join(clock)}" if clock else "no time column"
        raise InputError(f"{where}: {found}; name exactly one column t (or time), or pass time=")
    roles: dict[str, list[int]] = {"trajectory": [], "s": [], "p": [], "u": [], "q": []}
    for i, name in enumerate(names):
        role = "q" if coordinates is not None and name in coordinates else _role(key[name])
        if name != clock[0] and role in roles and not (role == "q" and coordinates and name not in coordinates):
            roles[role].append(i)
    q = tuple(roles["q"]) if coordinates is None else tuple(names.index(x) for x in coordinates)
    if not q:
        raise InputError(f"{where}: no coordinate column, only {', '.join(names)}; add a column such as q[rad]")
    if len(roles["trajectory"]) > 1:
        raise InputError(f"{where}: both a column trajectory and a column trial; keep one")
    p = _momenta(where, [names[i] for i in q], {names[i]: i for i in roles["p"]})
    one = {x: roles[x][0] if roles[x] else None for x in ("trajectory", "s")}
    return Columns(names, units, names.index(clock[0]), q, one["trajectory"], one["s"], p, tuple(roles["u"]))


def _parse(cells: Sequence[str], where: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    names, units = [], []
    for i, cell in enumerate(cells):
        match = HEADER_CELL.fullmatch(cell)
        if match is None or not cell.isprintable():
            raise InputError(f"{where}, column {i + 1}: {quote(cell)} is not a header cell; write name or name[unit]")
        name = match[1]
        if name in names:
            raise InputError(f"{where}: the column {quote(name)} comes twice; rename or delete one")
        names.append(name)
        units.append((match[2] or "").strip())
    if all(_is_number(name) for name in names):
        raise InputError(f"{where}: the header is missing (only numbers there); add a first line such as t[s],q[rad]")
    return tuple(names), tuple(units)


def _role(key: str) -> str:
    if key in TIME:
        return "time"
    if key in TRAJECTORY:
        return "trajectory"
    for role, pattern in (("s", ACTION), ("p", MOMENTUM), ("u", INPUT), ("velocity", VELOCITY)):
        if pattern.fullmatch(key):
            return role
    return "q"


def _momenta(where: str, q: list[str], p: dict[str, int]) -> tuple[int, ...]:
    """Order the momentum columns as their coordinates: p_theta belongs to theta."""
    if not p:
        return ()
    wanted = [f"p_{name}" for name in q]
    if set(p) == set(wanted):
        return tuple(p[name] for name in wanted)
    if len(q) == len(p) == 1:
        return tuple(p.values())
    raise InputError(f"{where}: momentum columns {', '.join(p)} are not {', '.join(wanted)}; rename or delete them")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
