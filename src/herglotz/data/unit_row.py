"""A row of units below the header, as measuring programs write it."""

from __future__ import annotations

from collections.abc import Sequence

from herglotz.data.column_roles import name_and_unit
from herglotz.data.csv_columns import Wanted, assign, is_number
from herglotz.data.units import PER_SECOND
from herglotz.errors import refuse


def with_units(cells: Sequence[str], below: Sequence[str], where: str, wanted: Wanted) -> list[str] | None:
    """The header's cells as `name[unit]` with the units of the row below; None if that row holds no units.

    The row holds units if no cell is a number, and the cell of the time is a unit of time. Raise InputError, which
    begins with `where` (file and row), if a name has different units in the header and below, or as
    `herglotz.data.csv_columns.assign`.
    """
    units = [_bare(cell) for cell in below]
    if len(units) != len(cells) or not {"s", *PER_SECOND}.intersection(units) or any(map(_is_sample, units)):
        return None
    own = [(name_and_unit(cell) or ("", ""))[1] for cell in cells]
    named = list(zip(cells, units, own, strict=True))
    both = [f"{cell!r} and below it {unit!r}" for cell, unit, head in named if head and unit not in ("", head)]
    refuse({f"{where}: two units of one column, {both and both[0]}; keep one of them": both})
    found = [f"{cell}[{unit}]" if unit and not head else cell for cell, unit, head in named]
    clock = assign(found, where, wanted).time
    return found if units[clock] in ("s", *PER_SECOND) else None


def _bare(cell: str) -> str:
    """A unit without brackets; a dash stands for no unit."""
    return cell.strip("[]()<> ").removesuffix("-")


def _is_sample(unit: str) -> bool:
    """Whether a cell is a number; 1 may be the unit of plain numbers instead."""
    return is_number(unit) and unit != "1"
