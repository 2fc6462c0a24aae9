"""Trajectories as comma-separated text: `trajectory,t[s],q[rad],...`, one row a sample."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from herglotz.data.csv_columns import Columns, assign
from herglotz.data.files import PathLike, read_lines, write_atomically
from herglotz.data.rows import group_rows, number, quote
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError

HOLD = r"#\s*hold:\s*(\w+)"  # the comment that says what inputs do between samples


def read_csv(
    path: PathLike,
    *,
    time: str | None = None,  # name of the time column; left out: t or time
    coordinates: str | Sequence[str] | None = None,  # left out: every column without another role
    angles: str | Sequence[str] | None = None,  # coordinates that are angles; left out: those in rad; () for none
) -> Trajectories:
    """Read trajectories from a csv file (UTF-8, commas, a decimal point).

    The header's cells are `name` or `name[unit]`. `t` or `time` is the time; `trajectory` or `trial`, if there, groups
    the rows; `s` is the action, `p`/`p_*` momenta, `u`/`u_*`/`torque` inputs; velocities (`v`, `velocity`, `*_dot`) are
    left aside; every other column is a coordinate. Lines that start with # and blank lines are skipped, but for
    `# hold: zero` (or `first`, `smooth`), which says what the inputs do between samples (`herglotz.data.holds`).
    A coordinate in rad is taken for an angle.

    Returns
    -------
    Trajectories
        In float64, as measured (angles are not unwrapped; `load` does that).

    Raises
    ------
    InputError
        Naming file, row (line of the file, from 1), column, value and remedy.
    """
    lines = read_lines(path)
    rows = [(i, line) for i, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith("#")]
    if not rows:
        raise InputError(f"{Path(path)}: there is no header; add a first line such as t[s],q[rad]")
    at, header = rows[0]
    if "," not in header and (";" in header or "\t" in header):
        raise InputError(f"{Path(path)}, row {at}: columns are separated by commas here; replace ';' or tabs by ','")
    wanted = (coordinates,) if isinstance(coordinates, str) else coordinates
    columns = assign(_cells(header), f"{Path(path)}, row {at}", time, wanted)
    found = _build(Path(path), columns, *_parse_rows(Path(path), columns, rows[1:]), angles)
    said = [match[1] for line in lines if (match := re.fullmatch(HOLD, line.strip()))]
    return replace(found, hold=said[0]) if said else found


def write_csv(path: PathLike, trajectories: Trajectories, *, comments: Sequence[str] = ()) -> None:
    """Write trajectories so that `read_csv` returns the same numbers, bit for bit, atomically.

    `comments` become lines that start with #. A coordinate in rad that is not an angle is written too, although
    `read_csv` reads it as an angle unless it is given `angles=()`.

    Raises
    ------
    InputError
        If a coordinate's name or a unit cannot stand in the header (it has a comma, or means another column).
    """
    q = trajectories.names
    header = ["trajectory", f"t[{trajectories.time_unit}]"]
    header += [f"{name}[{unit}]" for name, unit in zip(q, trajectories.units, strict=True)]
    parts = [trajectories.t[:, None], trajectories.q]
    if trajectories.s is not None:
        header, parts = [*header, "s"], [*parts, trajectories.s[:, None]]
    if trajectories.p is not None:
        header, parts = header + [f"p_{name}" for name in q], [*parts, trajectories.p]
    if trajectories.u is not None:
        header, parts = header + [f"u_{i}" for i in range(trajectories.u.shape[1])], [*parts, trajectories.u]
    _check_header(Path(path), header, trajectories)
    table = np.concatenate([x.detach().cpu().numpy().astype(np.float64) for x in parts], axis=1).tolist()
    names = trajectories.trajectory.tolist()
    comments = [*comments, f"hold: {trajectories.hold}"] if trajectories.hold else comments
    lines = [f"# {line}" for text in comments for line in text.splitlines()] + [",".join(header)]
    lines += [",".join([str(b), *map(repr, row)]) for b, row in zip(names, table, strict=True)]
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def _cells(line: str) -> list[str]:
    return [cell.strip().strip('"').strip() for cell in line.split(",")]


def _parse_rows(
    path: Path, columns: Columns, rows: Sequence[tuple[int, str]]
) -> tuple[list[int], list[str], list[list[float]]]:
    """Return line number, trajectory label and numbers of every row."""
    width, labels, values = len(columns.names), [], []
    for at, line in rows:
        cells = _cells(line)
        if len(cells) != width:
            raise InputError(
                f"{path}, row {at}: {len(cells)} cells where the header has {width}; correct or delete the row"
            )
        values.append([number(cells[i], f"{path}, row {at}, column '{columns.names[i]}'") for i in columns.numeric])
        labels.append("" if columns.trajectory is None else cells[columns.trajectory])
    if any(labels) and not all(labels):
        at = rows[labels.index("")][0]
        raise InputError(f"{path}, row {at}, column 'trajectory': blank, but other rows name a trajectory; fill it in")
    return [at for at, _ in rows], labels, values


def _build(
    path: Path,
    columns: Columns,
    at: list[int],
    labels: list[str],
    values: list[list[float]],
    angles: str | Sequence[str] | None,
) -> Trajectories:
    groups = group_rows(path, at, labels, [row[0] for row in values], ("trajectory", columns.names[columns.time]))
    table = np.array([values[row] for group in groups for row in group], dtype=np.float64)
    widths = [1, len(columns.q), 0 if columns.s is None else 1, len(columns.p), len(columns.u)]
    t, q, s, p, u = np.split(table, np.cumsum(widths)[:-1], axis=1)
    units = tuple(columns.units[i] or "1" for i in columns.q)
    found = Trajectories.of(
        t[:, 0],
        q,
        tuple(len(group) for group in groups),
        names=tuple(columns.names[i] for i in columns.q),
        units=units,
        angles=tuple(unit == "rad" for unit in units),
        s=s[:, 0] if s.size else None,
        p=p if p.size else None,
        u=u if u.size else None,
        time_unit=columns.units[columns.time] or "s",
        source=path.name,
    )
    return found if angles is None else found.with_angles(angles)


def _check_header(path: Path, header: list[str], trajectories: Trajectories) -> None:
    """Raise unless `read_csv` would give every column of this header its present role."""
    line = ",".join(header)
    try:
        if "\n" in line or "\r" in line:
            raise InputError("a line break in it")
        back = assign(_cells(line), "header")
        same = [back.names[i] for i in back.q] == list(trajectories.names) and len(back.names) == len(header)
        units = tuple(back.units[i] for i in back.q) == trajectories.units
        clock = back.time == 1 and back.units[1] == trajectories.time_unit
    except InputError as error:
        raise InputError(f"{path}: the header {quote(line)} could not be read back ({error}); rename") from error
    if not (same and units and clock):
        raise InputError(
            f"{path}: coordinates {trajectories.names} in {trajectories.units} would not be read back from csv; "
            "rename those that mean another column (t, s, p, u, v, ...), or save as .npz"
        )
