"""One number for a free run, the four words for a fit, and the table of a zoo."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.judging.tables import number, shown, table
from benchmarks.zoo_systems.mechanisms import Array
from benchmarks.zoo_systems.systems import ZooSystem

AT_NOISE = 1.5  # times the noise: RMS of the free run against noisy samples, where a perfect model has 1
USABLE = 0.1  # of the size of the motion
AT, USE, SAID, SILENT = OUTCOMES = ("at the noise", "usable", "said it failed", "failed silently")

Predictions = Mapping[str, tuple[Array, Array]]  # part → (prediction, data), each (N, n)


def score(of: ZooSystem, found: Predictions) -> float:
    """RMS error over the noise, the worse of the two parts; infinite where a sample was not reached."""
    return _worst(found, of.floor)


def relative(of: ZooSystem, found: Predictions) -> float:
    """RMS error over the size of the motion, the worse of the two parts."""
    return _worst(found, of.size)


def outcome(score: float, relative: float, said: bool) -> str:
    """One of `OUTCOMES`. `said`: whether the fit itself called its result a failure."""
    if score <= AT_NOISE:
        return AT
    if relative <= USABLE:
        return USE
    return SAID if said else SILENT


def _worst(found: Predictions, unit: Array) -> float:
    parts = []
    for prediction, data in found.values():
        error = np.where(np.isfinite(prediction), prediction, np.inf) - data
        parts.append(float(np.sqrt(np.mean(np.square(error / unit)))))
    return max(parts)


Row = dict[str, Any]
METHODS = {"ours": "ours", "sindy": "SINDy", "neural_ode": "neural ODE", "known": "known"}


def shares(rows: Sequence[Row]) -> dict[str, float]:
    """Share of the systems with each outcome, and of those where our free runs are not behind SINDy's."""
    found = {name: sum(row["outcome"] == name for row in rows) / len(rows) for name in OUTCOMES}
    for peer in ("sindy", "neural_ode"):
        if all(f"ahead_of_{peer}" in row for row in rows):
            found[f"ahead of {METHODS[peer]}"] = sum(row[f"ahead_of_{peer}"] for row in rows) / len(rows)
    return found


def ahead(mine: float, theirs: float) -> bool:
    """Whether our error is not behind that of a peer; errors at the noise are alike."""
    return math.isfinite(mine) and mine <= max(theirs, 1.0)


KNOWN = "Known: the true equation with its numbers fitted."
OPEN = "No dictionary holds these systems. Attainable: the true equation with its numbers, started from the warm-up."


def report(rows: Sequence[Row], zoo: str, flags: str) -> str:
    """Markdown of a zoo, from what it is called and the flags that measured it."""
    commits = ", ".join(sorted({row["commit"] for row in rows}))
    methods = [name for name in METHODS if all(name in row for row in rows)]
    medians = {METHODS[name]: statistics.median(number(row[name]["score"]) for row in rows) for name in methods}
    cpu = statistics.median(row["ours"]["cpu_s"] for row in rows)
    attained = all("attainable" in row for row in rows)
    lines = [
        f"# {zoo}",
        "",
        f"`python benchmarks/zoo.py {flags}` at commit {commits}.",
        "",
        "Numbers are errors of free runs over the noise (1: a perfect model; without noise over 1e-4 of the size), the",
        "worse of two: the unseen third of the training recordings, and three recordings from unseen starts. In",
        "brackets: over the size of the motion. Time: of our fit, on one processor.",
        OPEN if attained else KNOWN,
        "",
        *table(("share", *shares(rows)), [(f"of {len(rows)}", *(f"{100 * x:.0f} %" for x in shares(rows).values()))]),
        "",
        "Medians: " + ", ".join(f"{name} {value:.3g}" for name, value in medians.items()) + f"; {cpu:.0f} s.",
        "",
    ]
    columns = [METHODS[name] for name in methods] + ["attainable"] * attained
    head = ("", "system", "samples", "outcome", *columns, "time, s", "what the fit said")
    return "\n".join([*lines, *table(head, [_cells(row, methods, attained) for row in rows]), ""])


def _cells(row: Row, methods: Sequence[str], attained: bool) -> list[Any]:
    """A line of the table."""
    ours = row["ours"]
    how = "/".join(str(ours[name]) for name in ("level", "objective") if name in ours)
    return [
        row["index"], row["name"], f"{row['trajectories']} × {row['samples'] // row['trajectories']}",
        f"**{row['outcome']}**" if row["outcome"] == SILENT else row["outcome"],
        *(f"{shown(row[name]['score'])} ({shown(row[name]['relative'])})" for name in methods),
        *([f"{row['attainable']:.3g}"] if attained else []),
        f"{ours['cpu_s']:.0f}", f"{how} {ours['said'] or ours.get('verdict') or ''}".strip(),
    ]  # fmt: skip
