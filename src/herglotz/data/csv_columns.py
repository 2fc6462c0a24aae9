"""The role of each column of a table: time, trajectory, coordinate, action, momentum, input, left aside; in words."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from herglotz.data.rows import quote
from herglotz.errors import InputError, refuse

HEADER_CELL = re.compile(r"([^\[\]]+?)(?:\s*\[([^\[\]]*)\]|\s+\(([^()]*)\))?\s*")
# A unit at the end of a name, of angles, their rates and times alone: theta_m may be the angle of a motor.
SUFFIX = re.compile(r"(?!p_)(.+)_(deg|rad|(?:deg|rad)_s2?)|(t|time|timestamp)_(s|ms|us|ns|min)", re.I)
ROLES = {
    "time": re.compile(r"t|time|timestamp|datetime"),
    "trajectory": re.compile(r"trajectory|trial|run"),
    "action": re.compile(r"s"),
    "momentum": re.compile(r"p|p_.*"),
    "input": re.compile(
        r"u\d*|u_.*|F|f(\d+|_.*)|(forces?|torques?|tau|motor|efforts?|inputs?|controls?|commands?|cmd|pwm|voltage|current)"
        r"(\d+|_.*)?"
    ),
    # Left aside: logged velocities and accelerations are usually filtered, and counters of rows are no motion.
    "rate": re.compile(
        r"v|v[xyz]|a[xyz]|(vel|velocity|speed|acc|acceleration|omega)(_.*)?|.*_(d?dot|velocity|acceleration)"
        r"|([qxyz]|theta|phi)\d*d?dot"
    ),
    "counter": re.compile(r"index|row|sample|frame|unnamed: \d+"),
}
LETTERS = re.compile(r"v|[va][xyz]")  # of a velocity or an acceleration, unless the unit is that of a position
POSITIONS = re.compile(r"rad|deg|°|[kcmµμn]?m|in|ft|px")
AS_SHOWN = {  # roles by their names in the table of columns
    "time": "time", "trajectory": "trajectory", "coordinate": "q", "input": "input", "left aside": "dropped",
}  # fmt: skip
FORCES = re.compile(r"[kmM]?N([ *·.]?m)?")  # units in which no coordinate is measured
RATES = re.compile(r".+/ ?(s|ms|min|h)(\^?2|²)?")  # nor in these: m/s, rad/s²
Names = str | Sequence[str]


@dataclass(frozen=True)
class Wanted:
    """What the user says of the columns, each by name; None where the header decides."""

    time: str | None = None
    coordinates: Names | None = None  # exactly these
    inputs: Names | None = None  # exactly these; () for none
    drop: Names = ()  # left aside
    group: str | None = None  # numbers the trajectories
    known: tuple[tuple[str, str, str], ...] = ()  # name, role, unit in another table: names keep their roles
    motion: bool = True  # False: times and inputs suffice; without coordinates the first input stands in for one

    def role(self, name: str) -> str | None:
        """The role that the user gives to this column; None where the user says nothing."""
        given = (("time", self.time), ("trajectory", self.group), ("dropped", self.drop), ("q", self.coordinates))
        for role, wanted in (*given, ("input", self.inputs)):
            if name in as_names(wanted or ()):
                return role
        return None

    def __bool__(self) -> bool:
        return bool(self.names) or self.inputs is not None or self.coordinates is not None

    @property
    def names(self) -> tuple[str, ...]:
        """All columns that the user names."""
        every = (self.time, self.group, self.drop, self.coordinates, self.inputs)
        return tuple(name for wanted in every if wanted for name in as_names(wanted))

    def by_name(self, cells: Sequence[str], names: Sequence[str]) -> Wanted:
        """The same with the name of each column that is given as its whole cell, `x (m)`."""
        every = set(names)
        called = {cell: name for cell, name in zip(cells, names, strict=True) if cell not in every}

        def named(wanted: Names | None) -> Any:
            of = [called.get(name, name) for name in as_names(wanted or ())]
            return wanted if not wanted else of[0] if isinstance(wanted, str) else tuple(of)

        who = ("time", "group", "drop", "coordinates", "inputs")
        return replace(self, **{field: named(getattr(self, field)) for field in who})

    def before(self, name: str) -> str | None:
        """The role that a column of this name had in the other table; None where it had none."""
        return next((AS_SHOWN.get(role) for other, role, _ in self.known if other == name), None)

    def in_order(self, found: Sequence[int], names: Sequence[str]) -> tuple[int, ...]:
        """Column numbers in the order that the other table has their names in, new names last."""
        rank = {name: k for k, (name, _, _) in enumerate(self.known)}
        return tuple(sorted(found, key=lambda i: rank.get(names[i], len(rank))))


HEADER_DECIDES = Wanted()


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
        """Columns whose cells are parsed as numbers, time first."""
        return (self.time, *self.q, *(() if self.s is None else (self.s,)), *self.p, *self.u)

    def roles(self) -> tuple[tuple[str, str, str], ...]:
        """Name, role and unit of every column, in the order of the header."""
        named = {self.time: "time", self.trajectory: "trajectory", self.s: "action s"}
        named |= (
            dict.fromkeys(self.q, "coordinate") | dict.fromkeys(self.p, "momentum") | dict.fromkeys(self.u, "input")
        )
        rows = enumerate(zip(self.names, self.units, strict=True))
        return tuple((name, named.get(i, "left aside"), unit) for i, (name, unit) in rows)


def assign(
    cells: Sequence[str],  # the header's cells, `name` or `name[unit]`
    where: str,  # begins every message: file and row
    wanted: Wanted = HEADER_DECIDES,
) -> Columns:
    """Give every column of a header its role.

    Raise InputError if a cell cannot be read, a name comes twice, time or all coordinates are missing, or a named
    column is absent.
    """
    names, units = _parse(cells, where)
    place = {name: i for i, name in enumerate(names)}
    wanted = _dated(wanted.by_name(cells, names), names)
    every = ", ".join(names)
    refuse({f"{where}: there is no column {quote(x)}; the columns are {every}": x not in place for x in wanted.names})
    roles: dict[str, list[int]] = {role: [] for role in (*ROLES, "q", "dropped")}
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        roles[wanted.role(name) or _by_itself(name, unit, wanted)].append(i)
    clock = _clock(where, names, roles["time"])
    u = wanted.in_order(roles["input"], names)
    q = wanted.in_order(roles["q"], names) or (() if wanted.motion else u[:1])
    q = q if wanted.coordinates is None else tuple(place[x] for x in as_names(wanted.coordinates))
    both = " and a column ".join(names[i] for i in roles["trajectory"])
    refuse({
        f"{where}: holds no inputs, only {every}; name their columns u, u_*, force or torque": not (u or wanted.motion),
        f"{where}: no coordinate column, only {every}; {_remedy(names, roles)}": not q,
        f"{where}: both a column {both}; keep one": len(roles["trajectory"]) > 1,
    })  # fmt: skip
    p = _momenta(where, [names[i] for i in q], {names[i]: i for i in roles["momentum"]})
    trajectory, action = (next(iter(roles[role]), None) for role in ("trajectory", "action"))
    return Columns(names, units, clock, q, trajectory, action, p, u)


def _remedy(names: Sequence[str], roles: Mapping[str, list[int]]) -> str:
    """What to do about a table without a coordinate; what its columns are taken for is not printed."""
    alike = [
        f"{', '.join(names[i] for i in roles[role])} look like {role}s" for role in ("rate", "input") if roles[role]
    ]
    choose = f"{', '.join(alike)}: choose with --coordinates NAMES (coordinates= in Python)"
    return choose if alike else "add a column such as q[rad]"


def as_names(names: Names) -> Sequence[str]:
    """Names, of which one may be given by itself."""
    return (names,) if isinstance(names, str) else names


def _by_itself(name: str, unit: str, wanted: Wanted) -> str:
    """The role of a column that the user does not name, by another table or by its name and unit.

    It is `dropped` where the user gives that role to others.
    """
    key = name.casefold() if len(name) > 1 else name  # "Time" means time, but a single "V" may be a volume
    role = next((role for role, pattern in ROLES.items() if pattern.fullmatch(key)), "q")
    measured = "input" if FORCES.fullmatch(unit) else "rate" if RATES.fullmatch(unit) else role
    moves = role == "rate" and LETTERS.fullmatch(key) and POSITIONS.fullmatch(unit)
    role = wanted.before(name) or (measured if role == "q" else "q" if moves else role)
    taken = {"time": wanted.time, "trajectory": wanted.group, "q": wanted.coordinates, "input": wanted.inputs}
    return "dropped" if taken.get(role) is not None else role


def _dated(wanted: Wanted, names: Sequence[str]) -> Wanted:
    """The same; a column `date` is the time where nothing else is: beside a time of day it is none."""
    dates = [name for name in names if name.casefold() == "date"]
    if wanted.time is not None or len(dates) != 1 or any(ROLES["time"].fullmatch(name.casefold()) for name in names):
        return wanted
    return replace(wanted, time=dates[0])


def _clock(where: str, names: tuple[str, ...], found: list[int]) -> int:
    if len(found) == 1:
        return found[0]
    columns = f"the columns are {', '.join(names)}"
    if found:
        what = f"two time columns, {' and '.join(names[i] for i in found)}"
        raise InputError(f"{where}: {what}; choose one with --time NAME (time= in Python)")
    raise InputError(f"{where}: no time column; {columns}: choose one with --time NAME (time= in Python), or call it t")


def _parse(cells: Sequence[str], where: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    found = []
    for i, cell in enumerate(cells):
        of = name_and_unit(cell if cell or i else "index" if "index" not in cells else "unnamed: 0")  # as pandas writes
        if of is None:
            raise InputError(f"{where}, column {i + 1}: {quote(cell)} is not a header cell; write name or name[unit]")
        found.append(of)
    often = Counter(name for name, _ in found)
    found = [_whole(cell, of[1]) if often[of[0]] > 1 else of for cell, of in zip(cells, found, strict=True)]
    names, units = tuple(name for name, _ in found), tuple(unit for _, unit in found)
    for name, count in Counter(names).items():
        refuse({f"{where}: the column {quote(name)} comes twice; rename or delete one": count > 1})
    if all(is_number(name) for name in names):
        raise InputError(f"{where}: the header is missing (only numbers there); add a first line such as t[s],q[rad]")
    return names, units


def _whole(cell: str, unit: str) -> tuple[str, str]:
    """Name and unit of one of several cells of one name: brackets of `x (raw)` hold no unit, and `x_deg` is a name."""
    return (cell.strip(), "" if cell.endswith(")") else unit) if not cell.endswith("]") else (cell.split("[")[0], unit)


def name_and_unit(cell: str) -> tuple[str, str] | None:
    """What a cell of a header says, `x[m]`, `x (m)` or `x_deg`; None where it is no such cell."""
    match = HEADER_CELL.fullmatch(cell)
    if not match or not cell.isprintable():
        return None
    if match[2] is None and match[3] is None and (ends := SUFFIX.fullmatch(match[1])):
        return ends[1] or ends[3], (ends[2] or ends[4]).lower().replace("_", "/")
    return match[1], (match[2] or match[3] or "").strip()


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


def is_number(text: str) -> bool:
    """Whether Python reads this text as a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


ANGULAR = re.compile(r"(theta|phi|psi|angle|alpha|beta)(_?\d+|_.*)?", re.I)  # names that are given to angles


LISTED = 200  # columns of a table that is printed; a recording has fewer, and 100 000 fill a terminal for minutes


def column_table(data: Any) -> str:
    """Return of `Trajectories` a line a column: its role, its unit with the conversion that was made; then the notes.

    Of more than `LISTED` columns the first and the last ones are shown, and the number of the others.
    """
    rows = [("column", "is taken for", "unit"), *column_rows(data)]
    left = len(rows) - 1 - LISTED
    if left > 0:
        rows[1 + LISTED // 2 : 1 + LISTED // 2 + left] = [("…", f"{left} more", "")]
    widths = [max(len(row[k]) for row in rows) for k in range(2)]
    lines = [f"  {a:<{widths[0]}}  {b:<{widths[1]}}  {c}" for a, b, c in rows]
    return "\n".join([f"{data.source or 'table'}:", *lines, *(f"  {note}" for note in data.notes)])


def column_rows(data: Any) -> list[tuple[str, str, str]]:
    """Name, role and unit of each column of `Trajectories`, in words, after all that was said of it and made of it."""
    now = dict(zip(data.names, zip(data.units, data.angles, strict=True), strict=True))
    rows = []
    for name, role, unit in data.columns:
        if role == "coordinate" and name in now:
            role = "angle" if now[name][1] else role
            unit = _converted(unit, now[name][0])
            if role == "coordinate" and not unit and ANGULAR.fullmatch(name):
                unit = f"- (an angle in rad? --angles {name})"
        elif role == "time":
            unit = _converted(unit, data.time_unit) if unit else f"- (taken for {data.time_unit})"
        rows.append((name, role, unit or "-"))
    return rows


def _converted(unit: str, now: str) -> str:
    """The unit of a column, and what it became; of a column without a unit the one that it was given since."""
    given = "" if now == "1" else now
    return unit if unit == now else f"{unit}, converted to {now}" if unit else given
