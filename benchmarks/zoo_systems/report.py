"""One number for a free run, the four words for a fit, and the table of a zoo."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import harness
from benchmarks.harness import table
from benchmarks.judging.tables import number, shown
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
METHODS = {
    "ours": "ours", "neural_ode": "neural ODE", "forced_net": "discrete forced Lagrangian net",
    "delan": "DeLaN with friction", "gaussian": "Gaussian-process Lagrangian", "known": "known",
}  # fmt: skip
# What counts as good in the table of methods: RMS over the noise, and over the size of an exact motion.
NEAR, SMALL = 3.0, 1e-3


def shares(rows: Sequence[Row]) -> dict[str, float]:
    """Share of the systems with each outcome, and of those where our free runs are not behind those of a peer."""
    found = {name: sum(row["outcome"] == name for row in rows) / len(rows) for name in OUTCOMES}
    for peer, title in METHODS.items():
        if all(f"ahead_of_{peer}" in row for row in rows):
            found[f"ahead of {title}"] = sum(row[f"ahead_of_{peer}"] for row in rows) / len(rows)
    return found


def methods_of(rows: Sequence[Row]) -> list[str]:
    """Methods that every row has."""
    return [name for name in METHODS if all(name in row for row in rows)]


def standing(rows: Sequence[Row]) -> list[str]:
    """The table of methods: median error, shares of good ones, and how often and how far ours is ahead."""
    good = f"noisy: ≤ {NEAR:g} × the noise", f"exact: ≤ {SMALL:g} of the size"
    head = ("method", "median error", *good, "ours ahead", "its error over ours, median", "time of a fit, s, median")
    share = lambda good: f"{100 * sum(good) / len(good):.0f} %" if good else "–"  # noqa: E731
    lines = []
    for name in methods_of(rows):
        errors = [number(row[name]["score"]) for row in rows]
        ours = [number(row["ours"]["score"]) for row in rows]
        over = [x / y if y < math.inf else 0.0 for x, y in zip(errors, ours, strict=True)]
        lines.append((
            METHODS[name], shown(statistics.median(errors)),
            share([x <= NEAR for x, row in zip(errors, rows, strict=True) if row["noise"]]),
            share([number(row[name]["relative"]) <= SMALL for row in rows if not row["noise"]]),
            share([row[f"ahead_of_{name}"] for row in rows if f"ahead_of_{name}" in row]),
            shown(statistics.median(over)) if name != "ours" else "–",
            f"{statistics.median(row[name]['cpu_s'] for row in rows):.0f}",
        ))  # fmt: skip
    return table(head, lines)


def ahead(mine: float, theirs: float) -> bool:
    """Whether our error is not behind that of a peer; errors at the noise are alike."""
    return math.isfinite(mine) and mine <= max(theirs, 1.0)


KNOWN = "Known: the true equation with its numbers fitted."
OPEN = "No dictionary holds these systems. Attainable: the true equation with its numbers, started from the warm-up."


def report(rows: Sequence[Row], zoo: str, flags: str) -> str:
    """Markdown of a zoo, from what it is called and the flags that measured it."""
    commits = ", ".join(sorted({row["commit"] for row in rows}))
    methods, outcomes = methods_of(rows), {name: x for name, x in shares(rows).items() if name in OUTCOMES}
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
        *table(("share", *outcomes), [(f"of {len(rows)}", *(f"{100 * x:.0f} %" for x in outcomes.values()))]),
        "",
        *standing(rows),
        "",
    ]
    columns = [METHODS[name] for name in methods] + ["attainable"] * attained
    head = ("", "system", "samples", "outcome", *columns, "time, s", "what the fit said")
    return "\n".join([*lines, *table(head, [_cells(row, methods, attained) for row in rows]), ""])


def _cells(row: Row, methods: Sequence[str], attained: bool) -> list[Any]:
    """A line of the table."""
    ours = row["ours"]
    how = "/".join(str(ours[name]) for name in ("level", "objective") if name in ours)
    verdict = str(ours.get("verdict") or ours["said"]).split(":")[0]
    warned = "; predict warns of its range" if ours["said"].startswith("predict") else ""
    return [
        row["index"], row["name"], f"{row['trajectories']} × {row['samples'] // row['trajectories']}",
        f"**{row['outcome']}**" if row["outcome"] == SILENT else row["outcome"],
        *(f"{shown(row[name]['score'])} ({shown(row[name]['relative'])})" for name in methods),
        *([f"{row['attainable']:.3g}"] if attained else []),
        f"{ours['cpu_s']:.0f}", f"{how} {verdict}{warned}".strip(),
    ]  # fmt: skip


def draw(rows: Sequence[Row], title: str, path: Path) -> None:
    """Error over the noise of each method on each system: a row a method, a mark a system, a bar the median."""
    from herglotz.plots.style import INK, MODEL, MUTED, new_figure, styled

    methods = methods_of(rows)
    errors = {name: np.array([number(row[name]["score"]) for row in rows]) for name in methods}
    reached = np.log10([1.0, *(x for some in errors.values() for x in some if np.isfinite(x))])
    low, high = 10 ** np.floor(min(reached) - 0.1), 10 ** np.ceil(max(reached) + 0.1)
    lost, exact = high * (high / low) ** 0.06, np.array([not row["noise"] for row in rows])
    with styled():
        figure = new_figure(8.0, 1.5 + 0.42 * len(methods), f"{title}: error of free runs")
        ax = figure.subplots()
        for y, (name, found) in enumerate(errors.items()):
            color = MODEL if name == "ours" else INK
            place = y + 0.5 * (np.argsort(np.argsort(found)) / max(1, len(rows) - 1) - 0.5)  # marks do not hide another
            ended = np.isfinite(found)
            for some, mark, face in ((ended & ~exact, "o", color), (ended & exact, "o", "white"), (~ended, "x", color)):
                x = np.where(ended, found, lost)[some]
                ax.plot(x, place[some], mark, ms=4, mec=color, mfc=face, alpha=0.8, clip_on=False)
            middle = min(float(np.median(found)), lost)
            ax.plot([middle] * 2, [y - 0.36, y + 0.36], color=color, lw=2.2)
        ax.axvline(1.0, color=MUTED, lw=1.0, zorder=0)
        ax.set(xscale="log", xlim=(low, lost * (high / low) ** 0.02), ylim=(len(methods) - 0.4, -0.6))
        ax.set_yticks(range(len(methods)), [METHODS[name] for name in methods])
        ax.set_xlabel("RMS error over the noise (1: a perfect model; exact data: over 1e-4 of the size)")
        words = "● noisy recordings   ○ exact ones   × a free run that breaks down   | median"
        ax.set_title(words, fontsize=9, loc="left")
        ax.tick_params(axis="y", length=0)
        ax.grid(axis="x", color="#EEEEEE", lw=0.8)
        harness.picture(figure, path)
