"""The role of each column of a table: time, trajectory, coordinate, action, momentum, input, left aside."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from herglotz.data.checks import quote
from herglotz.data.column_roles import (
    BY_NAME,
    BY_UNIT,
    MOVED,
    READING,
    ROLES,
    Guess,
    heads_of,
    is_of_others,
    is_recorded_effort,
    is_set_point,
    is_shaken,
    is_timed,
    is_usual,
    kind_of,
    may_be_place,
    role_of,
    unit_of_time,
    words_of,
)
from herglotz.errors import InputError, refuse

# Fields of `Wanted` that give columns a role, and the role.
ROLE_OF_FIELD = {"time": "time", "group": "trajectory", "drop": "dropped", "coordinates": "q", "inputs": "input"}
# The doubt about an acceleration that is left aside.
OF_OTHERS = "no coordinate has its kind of unit, and it may be an input"
# Roles by their names in the table of columns.
AS_SHOWN = {
    "time": "time", "trajectory": "trajectory", "coordinate": "q", "input": "input", "left aside": "dropped",
}  # fmt: skip
# The doubts about several columns.
MANY = {
    BY_NAME: "by their names alone",
    BY_UNIT: "by their units alone",
    READING: "they may be the readings of positions",
    OF_OTHERS: "no coordinate has their kind of unit, and they may be inputs",
    "it may be an input": "they may be inputs",
    MOVED: "they may be moved from outside",
    "it has the unit of a position": "they have the unit of a position",
    "its name may be that of an input": "their names may be those of inputs",
    "its unit is none of a position": "their units are none of positions",
    "it may be a desired value or a derivative": "they may be desired values or derivatives",
    "it may be more than a filtered copy of another column": "they may be more than filtered copies of other columns",
}
# Names that a warning lists.
MAX_LISTED = 5
Names = str | Sequence[str]


@dataclass(frozen=True)
class Wanted:
    """The roles that the user gives to columns, by name; None if the header decides.

    Parameters
    ----------
    time, coordinates, inputs, drop, group
        The column of the time; exactly these coordinates; exactly these inputs, () for none; columns that are left
        aside; the column that numbers the trajectories.
    known
        Name, role and unit of each column of another table: columns of the same name keep their role.
    positions
        Further coordinates, unless `coordinates` names all.
    hold
        Hold of the inputs between samples, which overrules the file's; "": the file decides.
    known_hold
        Hold of the other table's inputs, where neither the user nor the file gives a hold.
    motion
        False if times and inputs suffice: an input then replaces a missing coordinate.
    """

    time: str | None = None
    coordinates: Names | None = None
    inputs: Names | None = None
    drop: Names = ()
    group: str | None = None
    known: tuple[tuple[str, str, str], ...] = ()
    positions: tuple[str, ...] = ()
    hold: str = ""
    known_hold: str = ""
    motion: bool = True

    def role(self, name: str) -> str | None:
        """The role that the user gives to this column, or None."""
        for field, role in ROLE_OF_FIELD.items():
            if name in as_names(getattr(self, field) or ()):
                return role
        return "q" if name in self.positions and self.coordinates is None else None

    def __bool__(self) -> bool:
        return bool(self.names) or self.inputs is not None or self.coordinates is not None

    @property
    def names(self) -> tuple[str, ...]:
        """All columns that the user names."""
        return tuple(name for field in (*ROLE_OF_FIELD, "positions") for name in as_names(getattr(self, field) or ()))

    def by_name(self, cells: Sequence[str], names: Sequence[str]) -> Wanted:
        """The same roles, with the name of each column that the user gives as its whole cell, `x (m)`."""
        name_of = dict(zip(cells, names, strict=True)) | {name: name for name in names}

        def named(wanted: Names | None) -> Any:
            found = [name_of.get(name, name) for name in as_names(wanted or ())]
            return wanted if not wanted else found[0] if isinstance(wanted, str) else tuple(found)

        return replace(self, **{field: named(getattr(self, field)) for field in (*ROLE_OF_FIELD, "positions")})

    def before(self, name: str) -> str | None:
        """The role of the column of this name in the other table; None if the other table has no such column."""
        return next((AS_SHOWN.get(role) for other, role, _ in self.known if other == name), None)

    def in_order(self, found: Sequence[int], names: Sequence[str]) -> tuple[int, ...]:
        """Column numbers in the order of their names in the other table, new names last."""
        rank = {name: k for k, (name, _, _) in enumerate(self.known)}
        return tuple(sorted(found, key=lambda i: rank.get(names[i], len(rank))))


HEADER_DECIDES = Wanted()


@dataclass(frozen=True)
class Columns:
    """Column numbers (from 0) by the role of the column.

    `names` and `units` are of all columns, as the header spells them, "" for no unit. `hold` of the inputs is the
    user's. `notes` are warnings of roles that are guesses.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    time: int
    q: tuple[int, ...]
    trajectory: int | None = None
    s: int | None = None
    p: tuple[int, ...] = ()
    u: tuple[int, ...] = ()
    hold: str = ""
    notes: tuple[str, ...] = ()

    @property
    def numeric(self) -> tuple[int, ...]:
        """Columns whose cells are parsed as numbers: time, coordinates, s, momenta, inputs."""
        return (self.time, *self.q, *(() if self.s is None else (self.s,)), *self.p, *self.u)

    def without(self, numbers: Collection[int]) -> Columns:
        """The columns with these coordinates and inputs left aside."""
        q, u = (tuple(i for i in own if i not in numbers) for own in (self.q, self.u))
        return replace(self, q=q, u=u)

    def roles(self) -> tuple[tuple[str, str, str], ...]:
        """Name, role and unit of every column, in the order of the header."""
        named = {self.time: "time", self.trajectory: "trajectory", self.s: "action s"}
        named |= (
            dict.fromkeys(self.q, "coordinate") | dict.fromkeys(self.p, "momentum") | dict.fromkeys(self.u, "input")
        )
        rows = enumerate(zip(self.names, self.units, strict=True))
        return tuple((name, named.get(i, "left aside"), unit) for i, (name, unit) in rows)


def assign(
    cells: Sequence[str],
    where: str,
    wanted: Wanted = HEADER_DECIDES,
    is_constant: Callable[[int], bool] | None = None,
    increases: Callable[[int], bool] | None = None,
) -> Columns:
    """Give every column of a header its role; the cells are `name` or `name[unit]`.

    Of several columns with the name of a group, those that are the same in every row (`is_constant`) are left aside;
    without `is_constant` the first is taken. Of several times those are meant that increase (`increases`). A time whose
    name says its unit, as `millis`, has this unit. Raise InputError, which begins with `where` (file and row), if a
    cell cannot be read, a name comes twice, time or all coordinates are missing, a named column is absent, or several
    columns group the rows.
    """
    names, units = _parse(cells, where, wanted)
    wanted = wanted.by_name(cells, names)
    _refuse_misnamed(where, names, wanted)
    guesses = _guesses(names, units, wanted)
    roles = {role: [i for i, x in enumerate(guesses) if x.role == role] for role in (*ROLES, "rate", "q", "dropped")}
    clock = _clock(where, names, _clocks(names, units, roles, increases))
    units = (*units[:clock], units[clock] or unit_of_time(names[clock]), *units[clock + 1 :])
    u = wanted.in_order(roles["input"], names)
    q = _coordinates(where, names, roles, u, wanted)
    p = _momenta(where, [names[i] for i in q], {names[i]: i for i in roles["momentum"]})
    groups, same = _varying(where, names, roles["trajectory"], is_constant)
    trajectory, action = (next(iter(own), None) for own in (groups, roles["action"]))
    found = Columns(names, units, clock, q, trajectory, action, p, u, wanted.hold)
    return replace(found, notes=(*_warnings(found, guesses, wanted), *same))


def _refuse_misnamed(where: str, names: Sequence[str], wanted: Wanted) -> None:
    """Raise InputError for a column that the user names and the table lacks, or that gets two roles."""
    every = ", ".join(names)
    refuse({f"{where}: there is no column {quote(x)}; the columns are {every}": x not in names for x in wanted.names})
    refuse({
        f"{where}: {quote(x)} is named for both {' and '.join(fields)}; a column has one role": len(fields) > 1
        for x in names if (fields := [f for f in ROLE_OF_FIELD if x in as_names(getattr(wanted, f) or ())])
    })  # fmt: skip


def _clocks(
    names: Sequence[str], units: Sequence[str], roles: dict[str, list[int]], increases: Callable[[int], bool] | None
) -> list[int]:
    """The columns that may be the time; of several those that increase."""
    clocks = roles["time"] or _other_clocks(names, units, roles)
    if increases is None or len(clocks) < 2:
        return clocks
    return [i for i in clocks if increases(i)] or clocks


def _coordinates(
    where: str, names: Sequence[str], roles: Mapping[str, list[int]], inputs: Sequence[int], wanted: Wanted
) -> tuple[int, ...]:
    """The columns of the coordinates; where inputs suffice, the first input stands for a missing one."""
    if wanted.coordinates is None:
        q = wanted.in_order(roles["q"], names)
    else:
        q = tuple(names.index(x) for x in as_names(wanted.coordinates))
    q = q or (() if wanted.motion else tuple(inputs[:1]))
    every, idle = ", ".join(names), not (inputs or wanted.motion)
    refuse({
        f"{where}: holds no inputs, only {every}; name their columns u, u_*, force or torque": idle,
        f"{where}: no coordinate column, only {every}; {_remedy(names, roles)}": not q,
    })  # fmt: skip
    return q


def _varying(
    where: str, names: Sequence[str], groups: Sequence[int], is_constant: Callable[[int], bool] | None
) -> tuple[Sequence[int], list[str]]:
    """The column that groups the rows, of those with the name of a group, and a note on those that never change."""
    if is_constant is None or len(groups) < 2:
        return groups, []
    same = [i for i in groups if is_constant(i)]
    varying = [i for i in groups if i not in same] or groups
    both = " and a column ".join(names[i] for i in varying)
    refuse({f"{where}: both a column {both}; keep one: --group NAME (group= in Python)": len(varying) > 1})
    return varying, [same_everywhere([names[i] for i in same])]


def same_everywhere(names: Sequence[str]) -> str:
    """The note on columns whose cells are all alike."""
    is_are = "is" if len(names) == 1 else "are"
    return f"{', '.join(names)} {is_are} the same in every row, and {is_are} left aside"


def _remedy(names: Sequence[str], roles: Mapping[str, list[int]]) -> str:
    """The remedy for a table without a coordinate: what its columns look like, and the flag that chooses."""
    looks = {
        "rate": ("looks like a rate", "look like rates"),
        "input": ("looks like an input", "look like inputs"),
        "dropped": ("looks like no position", "look like no positions"),
    }
    found = [
        f"{', '.join(names[i] for i in own)} {look[len(own) > 1]}"
        for role, look in looks.items() if (own := roles[role])
    ]  # fmt: skip
    if not found:
        return "add a column such as q[rad]"
    # A rate that is taken for a coordinate is modelled as a position.
    add = "integrate a rate over time into a column of its own, or, if one of these is a position, "
    ways = f"{add if roles['rate'] else ''}choose with --coordinates NAMES (coordinates= in Python)"
    return f"{', '.join(found)}: {ways}"


def as_names(names: Names) -> Sequence[str]:
    """A sequence of names; a single name may be given as a string."""
    return (names,) if isinstance(names, str) else names


def _guesses(names: Sequence[str], units: Sequence[str], wanted: Wanted) -> list[Guess]:
    """The role of every column; if no column is a coordinate, voltages of sensors are the coordinates."""
    heads = list(zip(names, units, strict=True))
    shaken = is_shaken(heads)
    guesses = [_guess(name, unit, wanted, names, shaken) for name, unit in heads]
    if wanted.motion and wanted.coordinates is None and all(guess.role != "q" for guess in guesses):
        return [Guess("q", "its unit is none of a position") if x.doubt == READING else x for x in guesses]
    return guesses


def _guess(name: str, unit: str, wanted: Wanted, others: Collection[str], shaken: bool) -> Guess:
    """The role that the user gives to a column, or else its role in another table, or else by its name and unit.

    The role is `dropped` if the user gives the found role to other columns.
    """
    if own := wanted.role(name):
        return Guess(own)
    known = wanted.before(name)
    guess = Guess(known) if known else role_of(name, unit, others, shaken)
    taken = [role for field, role in ROLE_OF_FIELD.items() if field != "drop" and getattr(wanted, field) is not None]
    return Guess("dropped") if guess.role in taken else guess


def _other_clocks(names: Sequence[str], units: Sequence[str], roles: dict[str, list[int]]) -> list[int]:
    """The time, in a table without a usual name of a time: by a word of a name, or else by a unit.

    These columns leave the other roles.
    """
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
        doubts[OF_OTHERS] = others
    own = [i for i in found.q if wanted.coordinates is None and wanted.before(found.names[i]) is None]
    unusual = [i for i in own if not is_usual(found.names[i], found.units[i]) and not guesses[i].doubt]
    # A single column without another role can only be the coordinate.
    if unusual and len(own) > 1:
        doubts["no unit and no usual name says so"] = unusual
    guessed = [] if wanted.inputs is not None else [i for i in found.u if wanted.before(found.names[i]) is None]
    return (*(_warning(found, columns, doubt) for doubt, columns in doubts.items()), *_of_controllers(found, guessed))


def _accelerations_of_others(found: Columns, guesses: Sequence[Guess], wanted: Wanted) -> list[int]:
    """Accelerations that are left aside and belong to no coordinate."""
    units = [found.units[i] for i in found.q]
    return [
        i for i, (name, unit, guess) in enumerate(zip(found.names, found.units, guesses, strict=True))
        if wanted.role(name) is None and wanted.before(name) is None and guess == Guess("rate")
        and is_of_others(unit, units)
    ]  # fmt: skip


def _of_controllers(found: Columns, inputs: Sequence[int]) -> list[str]:
    """A warning if both the set points of a controller, in the unit of a position, and its output are inputs."""
    wants = [found.names[i] for i in inputs if is_set_point(found.names[i], found.units[i])]
    does = [found.names[i] for i in inputs if is_recorded_effort(found.names[i], found.units[i])]
    if not wants or not does:
        return []
    goals, efforts = (", ".join(names[:MAX_LISTED]) for names in (wants, does))
    drop = shlex.quote(",".join(wants[:MAX_LISTED]))
    say, act = ("says" if len(wants) == 1 else "say"), ("does" if len(does) == 1 else "do")
    return [
        f"warning: {goals} {say} what a controller wants, and {efforts} {act} it: a model of both may have the "
        f"controller's law in the place of the machine's; --drop {drop} leaves the machine's"
    ]


def _warning(found: Columns, columns: Sequence[int], doubt: str) -> str:
    """The warning of these columns: their role, the doubt about the role, and the flags that change the role."""
    is_q, is_u = columns[0] in found.q, columns[0] in found.u
    names = [found.names[i] for i in columns]
    one = len(names) == 1
    doubt = doubt if one else MANY.get(doubt, doubt)
    few = ", ".join(names if len(names) <= MAX_LISTED else [*names[:MAX_LISTED], f"{len(names) - MAX_LISTED} more"])
    role = ("a coordinate" if one else "coordinates") if is_q else ("an input" if one else "inputs") if is_u else ""
    # No acceleration, no force and no share of a nominal value is a position.
    places = [name for i, name in zip(columns, names, strict=True) if may_be_place(name, found.units[i])]
    flags = {
        "inputs": ([] if is_u else names, found.u),
        "coordinates": ([] if is_q else places, found.q),
        "drop": (names if role else [], ()),
    }
    ways = [
        f"--{flag} {shlex.quote(','.join([*(found.names[i] for i in others), *own[:MAX_LISTED]]))}"
        for flag, (own, others) in flags.items() if own
    ]  # fmt: skip
    if set(columns) == set(found.q):
        ways = ["--inputs or --drop with the names of those that are none"]
    verb = ("is" if one else "are") + (f" taken for {role}" if role else " left aside")
    return f"warning: {few} {verb}, but {doubt}; {'else' if role else 'if so,'} give {' or '.join(ways)}"


def _clock(where: str, names: tuple[str, ...], found: list[int]) -> int:
    """The only column of the time; raise InputError if there is no such column, or several."""
    choose = "choose one with --time NAME (time= in Python)"
    columns, two = ", ".join(names), " and ".join(names[i] for i in found)
    refuse({
        f"{where}: no time column; the columns are {columns}: {choose}, or call it t": not found,
        f"{where}: two time columns, {two}; {choose}": len(found) > 1,
    })  # fmt: skip
    return found[0]


def _parse(cells: Sequence[str], where: str, wanted: Wanted) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of all columns; raise InputError for a cell without a name, and for a name that comes twice."""
    # pandas writes the numbers of the rows into a first column without a name.
    first = "index" if "index" not in cells else "unnamed: 0"
    texts = [cell if cell or i else first for i, cell in enumerate(cells)]
    found = heads_of(texts, {name for name, _, _ in wanted.known})
    for i, head in enumerate(found):
        if head is None:
            raise InputError(
                f"{where}, column {i + 1}: {quote(cells[i])} is not a header cell; write name or name[unit]"
                + ("" if cells[i] else ", and delete lines above the header, or begin them with #")
            )
    names, units = (tuple(head[k] for head in found if head) for k in (0, 1))
    for name, count in Counter(names).items():
        refuse({f"{where}: the column {quote(name)} comes twice; rename or delete one": count > 1})
    if all(is_number(name) for name in names):
        raise InputError(f"{where}: the header is missing (only numbers there); add a first line such as t[s],q[rad]")
    return names, units


def _momenta(where: str, q: list[str], p: dict[str, int]) -> tuple[int, ...]:
    """The columns of momenta in the order of their coordinates: p_theta belongs to theta."""
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
