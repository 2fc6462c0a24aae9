"""The text files that accompany Schmidt & Lipson, "Distilling free-form natural laws", Science 324:81 (2009)."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from herglotz.data.checks import number, quote
from herglotz.data.csv_columns import Columns
from herglotz.data.files import PathLike, read_lines
from herglotz.data.table import from_table
from herglotz.data.trajectories import Trajectories
from herglotz.errors import InputError

HEADER = re.compile(r"%\s*([ox]\d*(?:\s+[ox]\d*)*)((?:\s+[va]\d*)*)\s*")


def read_schmidt_lipson(path: PathLike) -> Trajectories:
    """Read one of the supplementary data files: `% o v` or `% x v`, then rows `trial t coordinate v`.

    A coordinate `o` is an angle in rad, here named `theta`; `x` is a position in pixels. Trials become trajectories.
    The files give no unit of time (`real_linear_h_1` is in s, `real_pend_h_1` in the video's own unit);
    `dataclasses.replace(data, time_unit="s")` sets it. Files of two coordinates (`% o1 o2 v1 v2`) follow the same
    pattern and are read too.

    Velocities (and accelerations) are left aside: in `real_pend_h_1` the column `v` is 0.954 times the true dq/dt,
    because it was smoothed, and a stepper is learned from positions alone.

    Returns
    -------
    Trajectories
        In float64, angles as they stand in the file.

    InputError names file, row (line of the file, from 1), column, value and remedy.
    """
    path = Path(path)
    rows = [(at, line.strip()) for at, line in enumerate(read_lines(path), 1) if line.strip()]
    header = rows[0][1] if rows else ""
    match = HEADER.fullmatch(header)
    if match is None:
        got = quote(header) if header else "nothing"
        raise InputError(f"{path}: the first line must be like '% o v' or '% x v', got {got}; is this another format?")
    coordinates = match[1].split()
    width = 2 + len(coordinates) + len(match[2].split())
    labels = ["trial", "t", *coordinates]
    numbers = []
    for at, line in rows[1:]:
        cells = line.split()
        if len(cells) != width:
            raise InputError(f"{path}, row {at}: {len(cells)} numbers where {width} belong; correct or delete the row")
        named = zip(labels, cells, strict=False)  # velocities come last and are not looked at
        numbers.append([number(cell, f"{path}, row {at}, column '{label}'") for label, cell in named])
    names = tuple(label.replace("o", "theta") for label in labels)
    units = ("", "", *("rad" if name.startswith("o") else "pixel" for name in coordinates))
    columns = Columns(names, units, time=1, q=tuple(range(2, len(labels))), trajectory=0)
    trials = [f"{row[0]:g}" for row in numbers]
    found = from_table(path, columns, [at for at, _ in rows[1:]], trials, [row[1:] for row in numbers])
    return replace(found, time_unit="1", columns=())  # the format, not a header, says what each column is
