"""The table of a run of the judge, and the comparison of two."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

from benchmarks.harness import table

Row = dict[str, Any]

# A row is worse or slower beyond these. Processor time of one fit differs by 10 % between quiet runs, and by up to 30 %
# beside other work; starting Python takes 2 s.
WORSE, SLOWER, LONGER = 1.1, 1.3, 2.0
# A row is worse only if the logarithm of the ratio of errors exceeds this number of its standard errors.
CLEARLY = 2.0
# Errors below this part of the spread are rounding, and have no meaningful ratio.
FLOOR = 1e-6
# A standard error needs at least this number of parts.
FEWER = 2


def number(value: float | None) -> float:
    """An error for comparisons: what was not reached is infinite."""
    return math.inf if value is None else value


def shown(value: float | None, digits: int = 3) -> str:
    """A number for people."""
    return "not reached" if value is None or math.isinf(value) else f"{value:.{digits}g}"


def measured(rows: Sequence[Row]) -> list[Row]:
    """Rows that were run."""
    return [row for row in rows if "cpu_s" in row]


def report(result: dict[str, Any]) -> str:
    """Markdown of one run."""
    rows = measured(result["rows"])
    minutes, machine = sum(row["cpu_s"] for row in rows) / 60, result["machine"]
    verdicts = Counter(row["verdict"] for row in rows)
    false = Counter(row["false"] for row in rows if row["false"])
    lines = [
        f"# The judge: commit {result['commit']}",
        "",
        f"`python benchmarks/judge.py` on {result['date']}, {machine}; a limit of {result['limit_s']:g} s a row.",
        f"{len(rows)} rows took {minutes:.1f} min of processor time. Errors are of free runs over what the fit did not",
        "see, the worst group of each row; over the noise, a perfect model has 1. A false verdict praised a model that",
        "misses by more than 0.1 of the spread, or rejected one at the noise. `benchmarks/judging/` has the details.",
        "",
        "Verdicts: " + ", ".join(f"{name} {k}" for name, k in verdicts.most_common()) + ". False: "
        + (", ".join(f"{name} {k}" for name, k in false.items()) or "none") + ".",
        "",
    ]  # fmt: skip
    lines += [*table(("group", "rows", "at the noise", "false", "CPU, s"), _groups(rows)), ""]
    head = ("row", "error", "unit", "of the spread", "verdict", "false", "exit", "CPU, s", "MB")
    lines += table(head, [_row(row) for row in rows])
    left = [row for row in result["rows"] if "cpu_s" not in row]
    lines += ["", *(f"* {row['name']}: {row.get('skipped') or row.get('trouble')}" for row in left)]
    return "\n".join(lines).rstrip() + "\n"


def _row(row: Row) -> tuple[Any, ...]:
    """A line of the table of one run."""
    error, relative = (shown(row["error"]), shown(row["relative"], 2)) if row["asks"] else ("", "")
    code = "" if row["exit"] is None else row["exit"]
    return (row["name"], error, row["unit"], relative, row["verdict"], row["false"], code,
            f"{row['cpu_s']:.1f}", row["peak_mb"])  # fmt: skip


def _group(name: str) -> str:
    """Rows of a kind: the first word, and of the zoo the draw."""
    kind, _, _ = name.partition("/")
    return kind if kind.startswith(("zoo", "open")) else kind.split(" ")[0]


def _groups(rows: Sequence[Row]) -> list[tuple[Any, ...]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(_group(row["name"]), []).append(row)
    return [
        (name, len(some), sum(row["error"] is not None and row["unit"].startswith("over") and row["error"] <= 1.5
                              for row in some),
         sum(bool(row["false"]) for row in some), f"{sum(row['cpu_s'] for row in some):.0f}")
        for name, some in found.items()
    ]  # fmt: skip


def ratio(old: Row, new: Row, floor: float) -> tuple[float, float]:
    """Error of the new over the old one, and the standard error of its logarithm by leaving parts out in turn.

    Errors below `floor` of the spread count as that. The parts are those of the new row's worst group, which both rows
    have predicted; of a single part, or where the parts differ, the standard error is 0.
    """
    level = floor * number(new["spread"] or old["spread"] or 0.0)
    pair = [max(number(row["error"]), level) for row in (old, new)]
    if math.inf in pair:
        return (1.0 if pair[0] == pair[1] else 0.0 if pair[0] == math.inf else math.inf), 0.0
    worst = max(new["groups"], key=lambda name: _rms(new["groups"][name]), default="")
    a, b = (row["groups"].get(worst, []) for row in (old, new))
    whole = pair[1] / pair[0] if pair[0] else 1.0
    if len(a) != len(b) or len(a) < FEWER or any(x is None for x in (*a, *b)):
        return whole, 0.0
    each = [math.log(max(_rms(b[:i] + b[i + 1 :]), level, 1e-300) / max(_rms(a[:i] + a[i + 1 :]), level, 1e-300))
            for i in range(len(a))]  # fmt: skip
    mean, K = sum(each) / len(each), len(each)
    return whole, math.sqrt((K - 1) / K * sum((x - mean) ** 2 for x in each))


def _rms(parts: Sequence[float | None]) -> float:
    return math.sqrt(sum(number(x) ** 2 for x in parts) / len(parts))


def complaints(old: Row | None, new: Row | None, floor: float = FLOOR) -> list[str]:
    """What is worse in the new row; nothing where the old one has nothing to compare with."""
    if old is None or "cpu_s" not in old:
        return []
    if new is None or "cpu_s" not in new:
        return ["missing" if new is None else f"missing: {new.get('skipped') or new.get('trouble')}"]
    found = []
    if old["asks"]:
        times, sd = ratio(old, new, floor)
        if times > WORSE and math.log(times) > CLEARLY * sd:
            found.append(f"error × {times:.3g}")
    elif (old["exit"] == 0) > (new["exit"] == 0):
        found.append(f"verdict {old['verdict']} → {new['verdict']}")
    if new["false"] and not old["false"]:
        found.append(f"false verdict: {new['false']}, {new['verdict']}")
    if new["cpu_s"] > SLOWER * old["cpu_s"] and new["cpu_s"] > old["cpu_s"] + LONGER:
        found.append(f"time × {new['cpu_s'] / old['cpu_s']:.2g}")
    return found


def _error_ratio(old: dict[str, Any], new: dict[str, Any], floor: float) -> float:
    """Of the new error to the old one; no number where a row is not judged by its error."""
    return ratio(old, new, floor)[0] if old["asks"] and new["asks"] else math.nan


def _cells(name: str, old: dict[str, Any] | None, new: dict[str, Any] | None, said: list[str], floor: float) -> tuple:
    """A line of the comparison."""
    words = f"**{'; '.join(said)}**" if said else ""
    if old is None or new is None or "cpu_s" not in old or "cpu_s" not in new:
        return (name, "", "", "", "", "", f"**{said[0]}**" if said else "new" if old is None else "skipped")
    by = _error_ratio(old, new, floor)
    pair = f"{shown(old['error'])} → {shown(new['error'])}" if old["asks"] and new["asks"] else ""
    verdicts = old["verdict"] if old["verdict"] == new["verdict"] else f"{old['verdict']} → {new['verdict']}"
    times = f"{old['cpu_s']:.1f} → {new['cpu_s']:.1f}", f"{new['cpu_s'] / old['cpu_s']:.2g}"
    return (name, pair, "" if math.isnan(by) else f"{by:.3g}", verdicts, *times, words)


def compared(old: dict[str, Any], new: dict[str, Any], floor: float = FLOOR) -> tuple[str, int]:
    """Markdown of a comparison, and the number of worse rows."""
    before, after = ({row["name"]: row for row in result["rows"]} for result in (old, new))
    names = [*before, *(name for name in after if name not in before)]
    said = {name: complaints(before.get(name), after.get(name), floor) for name in names}
    worse = {name: words for name, words in said.items() if words}
    cells = [_cells(name, before.get(name), after.get(name), said[name], floor) for name in names]
    lines = [
        f"# The judge: {old['commit']} → {new['commit']}",
        "",
        f"{len(worse)} of {len(names)} rows are worse: an error above {WORSE:g} times the old one and outside",
        f"{CLEARLY:g} standard errors over recordings, a verdict that got false, {SLOWER:g} times and {LONGER:g} s",
        f"slower, or missing. Errors below {floor:g} of the spread count as that. Medians of the ratios:",
        _medians(
            [(before[row["name"]], row) for row in measured(list(after.values())) if row["name"] in before], floor
        ),
        "",
        *(f"* worse: {name}: {'; '.join(words)}" for name, words in worse.items()),
        "",
    ]
    head = ("row", "error", "ratio", "verdict", "CPU, s", "ratio", "worse")
    return "\n".join([*lines, *table(head, cells)]) + "\n", len(worse)


def _medians(pairs: Sequence[tuple[Row, Row]], floor: float) -> str:
    """Median ratios of errors and of times over rows of both runs that were measured, and the total times."""
    pairs = [pair for pair in pairs if len(measured(pair)) == 2]
    times = _median([b["cpu_s"] / a["cpu_s"] for a, b in pairs])
    errors = _median([by for by in (_error_ratio(a, b, floor) for a, b in pairs) if 0 < by < math.inf])
    old, new = (sum(pair[k]["cpu_s"] for pair in pairs) / 60 for k in range(2))
    return f"{shown(errors)} of error, {shown(times)} of time; {old:.1f} → {new:.1f} min."


def _median(values: Sequence[float]) -> float | None:
    ordered = sorted(values)
    return ordered[len(ordered) // 2] if ordered else None
