"""Names and units of a header's cells: `x[m]`, `x (m)`, `x(m)`, `x/m`, `v/(m/s)`, `x_mm` and `angleDeg`.

A slash stands before a known unit (ISO 80000-1: a quantity over its unit), unless another column has the same name
before a slash: `arm/A` beside `arm/B` is a path. A unit of time stands behind the name of a time alone, unlike `x/s`.

A unit that ends a name without brackets is one of `KINDS`. It is none where it is an index or a word:

* a unit of time behind another name than that of a time: `x_min`;
* a length behind the name of an angle: theta_m is the angle of a motor;
* a letter or a word (`AMBIGUOUS`) behind a name that says another role than the unit, as in `tau_m` and `x_A`, or
  beside a column of the same name with an index that is no unit: `joint_A` beside `joint_B`, `F_N` beside `F_T`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence

from herglotz.data.column_roles import (
    ANGLES,
    SYMBOL,
    WORDS,
    is_angular,
    is_time,
    is_timed,
    kind_of,
    role_of,
    words_of,
)

CELL = re.compile(r"([^\[\]]+?)(?:\s*\[([^\[\]]*)\]|\s+\(([^()]*)\))?\s*")
# A unit without a space before the bracket, if the bracket holds a known unit: x(1) is a name.
TIGHT = re.compile(r"([^()]+)\(([^()]+)\)")
# A quantity over its unit: t/s, phi / °, v/(m/s).
SLASH = re.compile(r"([^/\[\]()]+?)\s*/\s*(?:[\[(](.+)[\])]|([^\[\]()]+?))\s*")
# Units that are read in any case, and as the last word of a name in camel case.
CASELESS = re.compile(r"(?:deg|rad)(?:/s2?)?|mm|rpm|s|ms|us|ns|min", re.I)
# A name, and a unit of two parts or one at its end. The momentum of x_deg is p_x_deg.
ENDS = (
    re.compile(r"(?!p_)(.+)_(?!per_)([^\W_]+)_(?:per_)?(s2?|min|h|m)"),
    re.compile(r"(?!p_)(.+)_([^_]+)"),
    re.compile(rf"(?!p_)(.*[a-z\d])(?=[A-Z])((?i:{CASELESS.pattern}))"),
)
# What a unit of two parts begins with, beside lengths and angles: turns in French and German, litres, newtons.
PARTS = re.compile(r"tr|U|m?[lL]|[km]?N")
# Units that are letters of bodies or words as well.
AMBIGUOUS = re.compile(r"[mNAV]|cm|km|psi|bar")
INDEX = re.compile(r"[^\W_]|\d+")


def name_and_unit(cell: str) -> tuple[str, str] | None:
    """Name and unit of a header's cell, "" if the cell alone shows no unit; None for any other text."""
    match = CELL.fullmatch(cell)
    if not match or not cell.isprintable():
        return None
    if slash := SLASH.fullmatch(cell):
        name, unit = slash[1], slash[2] or slash[3]
        if kind_of(unit) and _is_timed(name) == (kind_of(unit) == "time"):
            return name, unit
    if match[2] is not None or match[3] is not None:
        return match[1], (match[2] or match[3]).strip()
    if (tight := TIGHT.fullmatch(match[1])) and kind_of(tight[2]):
        return tight[1], tight[2]
    name, unit = _split(match[1])
    return (match[1], "") if AMBIGUOUS.fullmatch(unit) else (name, unit)


def heads_of(cells: Sequence[str], known: Collection[str] = ()) -> list[tuple[str, str] | None]:
    """Name and unit of each cell of a table; None as in `name_and_unit`.

    Columns keep the names that they have in another table, whose names are `known`.
    """
    heads = [name_and_unit(cell) for cell in cells]
    names = [head[0] for head in heads if head]
    heads = [head and _in_table(cell, head, names, known) for cell, head in zip(cells, heads, strict=True)]
    count = Counter(head[0] for head in heads if head)
    return [_whole(cell, head[1]) if head and count[head[0]] > 1 else head
            for cell, head in zip(cells, heads, strict=True)]  # fmt: skip


def _in_table(cell: str, head: tuple[str, str], names: Sequence[str], known: Collection[str]) -> tuple[str, str]:
    """Name and unit of a cell beside columns of these names."""
    path = SLASH.fullmatch(cell) and any(name.startswith(f"{head[0]}/") for name in names)
    if cell in known or path or f"p_{cell}" in names:
        return cell, ""
    name, unit = _split(head[0])
    return (name, unit) if unit and not head[1] and (name in known or _is_unit(name, unit, names)) else head


def _whole(cell: str, unit: str) -> tuple[str, str]:
    """Name and unit of a cell whose name repeats: the brackets of `x (raw)` hold no unit, and `x_deg` is a name."""
    return (cell.strip(), "" if cell.endswith(")") else unit) if not cell.endswith("]") else (cell.split("[")[0], unit)


def _split(text: str) -> tuple[str, str]:
    """Name and unit of a name that ends with what may be its unit; the whole name and "" if it does not."""
    for match in filter(None, (end.fullmatch(text) for end in ENDS)):
        name, *parts = match.groups()
        unit = (" " if parts[-1] == "m" else "/").join(parts)
        unit = unit.lower() if CASELESS.fullmatch(unit) else unit
        if _may_have(name, unit):
            return name, unit
    return text, ""


def _is_timed(name: str) -> bool:
    """Whether a name is that of a time."""
    return is_time(name, "") or is_timed(words_of(name))


def _may_have(name: str, unit: str) -> bool:
    """Whether a column of this name may be in this unit: see the head of this module."""
    kind, part = kind_of(unit), kind_of(base := re.split("[/ ]", unit)[0])
    if not kind or (base != unit and part != "position" and not PARTS.fullmatch(base)):
        return False
    timed = _is_timed(name)
    length = part == "position" and not ANGLES.fullmatch(base)
    letter = len(unit) == 1 and unit.isalpha() and not AMBIGUOUS.fullmatch(unit)
    # x_in is the input beside x_out, x_lb the lower bound, and left_feet are feet.
    word = base in ("in", "feet", "lb")
    if timed != (kind == "time") or (length and is_angular(name)) or (letter and not timed) or word:
        return False
    return role_of(name, unit).role not in ("action", "momentum", "counter")


def _is_unit(name: str, unit: str, names: Sequence[str]) -> bool:
    """Whether an ambiguous end of a name is its unit, among columns of these names."""
    others = [other.removeprefix(f"{name}_") for other in names if other.startswith(f"{name}_")]
    if any(INDEX.fullmatch(other) and not _may_have(name, other) for other in others):
        return False
    symbol = re.fullmatch(rf"{SYMBOL}\d*", name.rsplit("_")[-1].casefold()) and not words_of(name) & WORDS["position"]
    told = role_of(name, "", names)
    if told.role != "q" or symbol:
        return told == role_of(name, unit, names)
    # A coordinate of one letter has a usual one: i_m may be the current of a motor.
    return len(name) > 1 or kind_of(unit) != "position"
