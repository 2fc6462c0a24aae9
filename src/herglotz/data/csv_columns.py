"""The role of each column of a table: time, trajectory, coordinate, action, momentum, input, left aside."""

from __future__ import annotations

import re
import shlex
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from herglotz.data.column_roles import (
    ANGLES,
    READING,
    ROLES,
    Guess,
    is_effort,
    is_goal,
    is_timed,
    is_usual,
    kind_of,
    role_of,
    words_of,
)
from herglotz.data.rows import quote
from herglotz.errors import InputError, refuse

HEADER_CELL = re.compile(r"([^\[\]]+?)(?:\s*\[([^\[\]]*)\]|\s+\(([^()]*)\))?\s*")
# A unit without a space before the bracket, if the bracket holds a known unit: x(1) is a name.
TIGHT = re.compile(r"([^()]+)\(([^()]+)\)")
# A unit at the end of a name, of angles, their rates and times alone: theta_m may be the angle of a motor.
SUFFIX = re.compile(r"(?!p_)(.+)_(deg|rad|(?:deg|rad)_s2?)|(t|time|timestamp)_(s|ms|us|ns|min)", re.I)
AS_SHOWN = {  # roles by their names in the table of columns
    "time": "time", "trajectory": "trajectory", "coordinate": "q", "input": "input", "left aside": "dropped",
}  # fmt: skip
FEW = 5  # names that a warning lists
Names = str | Sequence[str]


@dataclass(frozen=True)
class Wanted:
    """The roles that the user gives to columns, by name; None if the header decides."""

    time: str | None = None
    coordinates: Names | None = None  # exactly these
    inputs: Names | None = None  # exactly these; () for none
    drop: Names = ()  # left aside
    group: str | None = None  # numbers the trajectories
    known: tuple[tuple[str, str, str], ...] = ()  # name, role, unit in another table: names keep their roles
    positions: tuple[str, ...] = ()  # coordinates as well, unless `coordinates` says exactly which
    hold: str = ""  # hold of the inputs between samples, which overrules the file's; "": the file decides
    motion: bool = True  # False: times and inputs suffice; an input replaces a missing coordinate

    def role(self, name: str) -> str | None:
        """The role that the user gives to this column; None where the user says nothing."""
        given = (("time", self.time), ("trajectory", self.group), ("dropped", self.drop), ("q", self.coordinates))
        for role, wanted in (*given, ("input", self.inputs)):
            if name in as_names(wanted or ()):
                return role
        return "q" if name in self.positions and self.coordinates is None else None

    def __bool__(self) -> bool:
        return bool(self.names) or self.inputs is not None or self.coordinates is not None

    @property
    def names(self) -> tuple[str, ...]:
        """All columns that the user names."""
        every = (self.time, self.group, self.drop, self.coordinates, self.inputs, self.positions)
        return tuple(name for wanted in every if wanted for name in as_names(wanted))

    def by_name(self, cells: Sequence[str], names: Sequence[str]) -> Wanted:
        """The same with the name of each column that is given as its whole cell, `x (m)`."""
        every = set(names)
        called = {cell: name for cell, name in zip(cells, names, strict=True) if cell not in every}

        def named(wanted: Names | None) -> Any:
            of = [called.get(name, name) for name in as_names(wanted or ())]
            return wanted if not wanted else of[0] if isinstance(wanted, str) else tuple(of)

        who = ("time", "group", "drop", "coordinates", "inputs", "positions")
        return replace(self, **{field: named(getattr(self, field)) for field in who})

    def before(self, name: str) -> str | None:
        """The role of the column of this name in the other table; None if the other table has no such column."""
        return next((AS_SHOWN.get(role) for other, role, _ in self.known if other == name), None)

    def in_order(self, found: Sequence[int], names: Sequence[str]) -> tuple[int, ...]:
        """Column numbers in the order that the other table has their names in, new names last."""
        rank = {name: k for k, (name, _, _) in enumerate(self.known)}
        return tuple(sorted(found, key=lambda i: rank.get(names[i], len(rank))))


HEADER_DECIDES = Wanted()


@dataclass(frozen=True)
class Columns:
    """Column numbers (from 0) by the role of the column."""

    names: tuple[str, ...]  # of all columns, as the header spells them
    units: tuple[str, ...]  # of all columns, "" where the header gives none
    time: int
    q: tuple[int, ...]
    trajectory: int | None = None
    s: int | None = None
    p: tuple[int, ...] = ()
    u: tuple[int, ...] = ()
    hold: str = ""  # hold of the inputs between samples, as the user gives it
    notes: tuple[str, ...] = ()  # warnings of roles that are guesses

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
    guesses = _guesses(names, units, wanted)
    roles = {role: [i for i, x in enumerate(guesses) if x.role == role] for role in (*ROLES, "rate", "q", "dropped")}
    clock = _clock(where, names, roles["time"] or _other_clocks(names, units, roles))
    u = wanted.in_order(roles["input"], names)
    q = _coordinates(wanted, names, roles["q"]) or (() if wanted.motion else u[:1])
    both = " and a column ".join(names[i] for i in roles["trajectory"])
    refuse({
        f"{where}: holds no inputs, only {every}; name their columns u, u_*, force or torque": not (u or wanted.motion),
        f"{where}: no coordinate column, only {every}; {_remedy(names, roles)}": not q,
        f"{where}: both a column {both}; keep one": len(roles["trajectory"]) > 1,
    })  # fmt: skip
    p = _momenta(where, [names[i] for i in q], {names[i]: i for i in roles["momentum"]})
    trajectory, action = (next(iter(roles[role]), None) for role in ("trajectory", "action"))
    found = Columns(names, units, clock, q, trajectory, action, p, u, wanted.hold)
    return replace(found, notes=_warnings(found, guesses, wanted))


def _coordinates(wanted: Wanted, names: Sequence[str], found: Sequence[int]) -> tuple[int, ...]:
    """The columns of coordinates: the columns that the user names, in the user's order, or else the found columns."""
    if wanted.coordinates is None:
        return wanted.in_order(found, names)
    return tuple(names.index(x) for x in as_names(wanted.coordinates))


def _remedy(names: Sequence[str], roles: Mapping[str, list[int]]) -> str:
    """The remedy for a table without a coordinate, whose table of roles is never printed."""
    looks = {"rate": "look like rates", "input": "look like inputs", "dropped": "look like no positions"}
    alike = [f"{', '.join(names[i] for i in roles[role])} {look}" for role, look in looks.items() if roles[role]]
    choose = f"{', '.join(alike)}: choose with --coordinates NAMES (coordinates= in Python)"
    return choose if alike else "add a column such as q[rad]"


def as_names(names: Names) -> Sequence[str]:
    """A sequence of names; a single name may be given as a string."""
    return (names,) if isinstance(names, str) else names


def _guesses(names: Sequence[str], units: Sequence[str], wanted: Wanted) -> list[Guess]:
    """The role of every column; volts of a sensor are the motion if no other column is."""
    guesses = [_guess(name, unit, wanted, names) for name, unit in zip(names, units, strict=True)]
    if wanted.motion and wanted.coordinates is None and all(guess.role != "q" for guess in guesses):
        return [Guess("q", "its unit is none of a position") if x.doubt == READING else x for x in guesses]
    return guesses


def _guess(name: str, unit: str, wanted: Wanted, others: Collection[str]) -> Guess:
    """The role of a column by the user's word, by another table, or by its name and unit; and the doubt about the role.

    The role is `dropped` if the user gives the found role to other columns.
    """
    if said := wanted.role(name):
        return Guess(said)
    known = wanted.before(name)
    guess = Guess(known) if known else role_of(name, unit, others)
    taken = {"time": wanted.time, "trajectory": wanted.group, "q": wanted.coordinates, "input": wanted.inputs}
    return Guess("dropped") if taken.get(guess.role) is not None else guess


def _other_clocks(names: Sequence[str], units: Sequence[str], roles: dict[str, list[int]]) -> list[int]:
    """Columns that may be the time where none is called so: by a word of their names, or else by their unit."""
    free = [i for role in ("q", "dropped") for i in roles[role]]
    timed = [i for i in free if is_timed(words_of(names[i]))]
    found = [i for i in timed if kind_of(units[i]) in ("", "time")] or [i for i in free if kind_of(units[i]) == "time"]
    for role in ("q", "dropped"):
        roles[role] = [i for i in roles[role] if i not in found]
    return found


def _warnings(found: Columns, guesses: Sequence[Guess], wanted: Wanted) -> tuple[str, ...]:
    """Warnings of columns whose role is a guess, and of coordinates that neither a unit nor a usual name supports."""
    doubts: dict[str, list[int]] = {}
    for i, guess in enumerate(guesses):
        if guess.doubt:
            doubts.setdefault(guess.doubt, []).append(i)
    if others := _accelerations_of_others(found, guesses, wanted):
        doubts["no coordinate has its kind of unit, and it may be an input"] = others
    own = [i for i in found.q if wanted.coordinates is None and wanted.before(found.names[i]) is None]
    plain = [i for i in own if not is_usual(found.names[i], found.units[i]) and not guesses[i].doubt]
    if plain and len(own) > 1:  # a single column without a role can only be the coordinate
        doubts["no unit and no usual name says so"] = plain
    guessed = [] if wanted.inputs is not None else [i for i in found.u if wanted.before(found.names[i]) is None]
    return (*(_warning(found, columns, doubt) for doubt, columns in doubts.items()), *_of_control(found, guessed))


def _accelerations_of_others(found: Columns, guesses: Sequence[Guess], wanted: Wanted) -> list[int]:
    """Accelerations that are left aside, and are none of a coordinate: of lengths beside angles alone, or of angles."""
    units = [found.units[i] for i in found.q]
    turning = {bool(ANGLES.fullmatch(unit)) for unit in units}
    others = []
    for i, (name, unit, guess) in enumerate(zip(found.names, found.units, guesses, strict=True)):
        angular = bool(ANGLES.fullmatch(re.split(r"[/ ·*]", unit)[0]))
        new = wanted.role(name) is None and wanted.before(name) is None
        if new and guess == Guess("rate") and kind_of(unit) == "acceleration" and all(units) and angular not in turning:
            others.append(i)
    return others


def _of_control(found: Columns, inputs: Sequence[int]) -> list[str]:
    """What is said where both what a controller wants, in the unit of a position, and what it does are inputs."""
    words = {i: words_of(found.names[i]) for i in inputs}
    wants = [i for i in inputs if is_goal(words[i]) and not is_effort(words[i], found.units[i])]
    does = [i for i in inputs if not is_goal(words[i]) and is_effort(words[i], found.units[i])]
    if not wants or not does:
        return []
    goals, efforts = (", ".join(found.names[i] for i in of[:FEW]) for of in (wants, does))
    drop = shlex.quote(",".join(found.names[i] for i in wants[:FEW]))
    say, act = ("says" if len(wants) == 1 else "say"), ("does" if len(does) == 1 else "do")
    return [
        f"warning: {goals} {say} what a controller wants, and {efforts} {act} it: a model of both may have the "
        f"controller's law in the place of the machine's; --drop {drop} leaves the machine's"
    ]


def _warning(found: Columns, columns: Sequence[int], doubt: str) -> str:
    """The warning of these columns: their role, the doubt about the role, and the flags that change the role."""
    is_q, is_u = columns[0] in found.q, columns[0] in found.u
    names = [found.names[i] for i in columns]
    one, some = len(names) == 1, ",".join(names[:FEW])
    few = ", ".join(names if len(names) <= FEW else [*names[:FEW], f"{len(names) - FEW} more"])
    role = ("a coordinate" if one else "coordinates") if is_q else ("an input" if one else "inputs") if is_u else ""
    inputs, coordinates = (
        shlex.quote(",".join([*(found.names[i] for i in other), some])) for other in (found.u, found.q)
    )
    ways = [] if is_u else [f"--inputs {inputs}"]
    ways += [] if is_q else [f"--coordinates {coordinates}"]
    ways += [f"--drop {shlex.quote(some)}"] if role else []
    if set(columns) == set(found.q):
        ways = ["--inputs or --drop with the names of those that are none"]
    verb = ("is" if one else "are") + (f" taken for {role}" if role else " left aside")
    return f"warning: {few} {verb}, but {doubt}; else give {' or '.join(ways)}"


def _dated(wanted: Wanted, names: Sequence[str]) -> Wanted:
    """The same, with a column `date` as the time if no other column is a time, such as a time of day."""
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
    """Name and unit of a cell whose name repeats: the brackets of `x (raw)` hold no unit, and `x_deg` is a name."""
    return (cell.strip(), "" if cell.endswith(")") else unit) if not cell.endswith("]") else (cell.split("[")[0], unit)


def name_and_unit(cell: str) -> tuple[str, str] | None:
    """Name and unit of a header's cell, `x[m]`, `x (m)` or `x_deg`; None for any other text."""
    match = HEADER_CELL.fullmatch(cell)
    if not match or not cell.isprintable():
        return None
    if match[2] is not None or match[3] is not None:
        return match[1], (match[2] or match[3]).strip()
    if (tight := TIGHT.fullmatch(match[1])) and kind_of(tight[2]):
        return tight[1], tight[2]
    if ends := SUFFIX.fullmatch(match[1]):
        return ends[1] or ends[3], (ends[2] or ends[4]).lower().replace("_", "/")
    return match[1], ""


def _momenta(where: str, q: list[str], p: dict[str, int]) -> tuple[int, ...]:
    """Order the momentum columns as their coordinates: p_theta belongs to theta."""
    if not p:
        return ()
    wanted = [f"p_{name}" for name in q]
    if set(p) == set(wanted):
        return tuple(p[name] for name in wanted)
    if len(q) == len(p) == 1:
        return tuple(p.values())
    raise InputError(
        f"{where}: momentum columns {', '.join(p)} are not {', '.join(wanted)}; rename or delete them, or "
        f"leave them out with --drop {','.join(p)} (drop= in Python)"
    )


def is_number(text: str) -> bool:
    """Whether Python reads this text as a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True
