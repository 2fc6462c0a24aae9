"""What the default fit is worth, in one table: `python benchmarks/judge.py [--workers 2] [--quick] [--source FOLDER]`.

Rows are cases that once failed, the demonstration, measured sets, laws that no dictionary holds, the zoo, many
coordinates and the data of the peers. Each has the error of free runs, the verdict, the exit code, processor time and
peak memory. The fit runs by the command line with default flags, each in a process of its own, and its run is read by
public names: the package of `--source` (or of PYTHONPATH) is judged, whichever it is. `benchmarks/judging/` has the
parts.

A row that is done is kept in a file of JSON lines beside the table (`--out`), and is not measured again; the data of
rows are kept in runs/judge/prepared. `--compare OLD NEW` compares two tables and exits with 1 if a row is worse.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.judging import catalogue, tables
from benchmarks.judging.catalogue import Row
from benchmarks.judging.running import ROOT, Judge, environment

PREPARED = ROOT / "runs" / "judge" / "prepared"


def commit_of(source: Path | None) -> str:
    """Short name of the commit of the package that is judged, with a + where files of it were changed."""
    if source is not None:
        sys.path.insert(0, str(source))
    found = find_spec("herglotz")
    if found is None or found.origin is None:
        raise SystemExit("error: no package herglotz; give its folder with --source, or install it")
    package = Path(found.origin).parent
    git = lambda *words: subprocess.run(  # noqa: E731
        ["git", *words], cwd=package, capture_output=True, text=True, check=False
    ).stdout.strip()
    return git("rev-parse", "--short=8", "HEAD") + "+" * bool(git("status", "--short", "."))


def kept(path: Path, commit: str | None = None) -> dict[str, dict[str, Any]]:
    """Rows that an earlier run measured; one that was skipped, or whose line was cut short, is tried again."""
    rows: dict[str, dict[str, Any]] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else []:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if commit is not None and row["commit"] != commit:
            raise SystemExit(
                f"error: {path} holds rows of commit {row['commit']}, this is {commit}: take another --out"
            )
        if "cpu_s" in row:
            rows[row["name"]] = row
    return rows


def measure(
    wanted: Sequence[Row], rows: dict[str, dict[str, Any]], path: Path, workers: int, one: Callable[[Row], dict],
    commit: str,
) -> None:  # fmt: skip
    """Measure the rows that are not there yet, in order, and write each down as soon as it is done."""
    lock = threading.Lock()
    todo = [row for row in wanted if row.name not in rows]

    def run(of: Row) -> None:
        row = one(of) | {"commit": commit}
        with lock:
            rows[of.name] = row
            with path.open("a", encoding="utf-8") as file:
                file.write("\n" * _torn(path) + json.dumps(row, ensure_ascii=False) + "\n")
            print(f"{len(rows):3d}  {line(row)}", file=sys.stderr, flush=True)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(run, todo))


def _torn(path: Path) -> bool:
    """Whether the last line was cut short."""
    content = path.read_bytes()
    return bool(content) and not content.endswith(b"\n")


def line(row: dict[str, Any]) -> str:
    """A row for people."""
    if "cpu_s" not in row:
        return f"{row['name']}: {row.get('skipped') or row.get('trouble')}"
    error = f"{tables.shown(row['error'])} {row['unit']}" if row["asks"] else ""
    notes = f"{row['verdict']}  {row['false']}  {row['trouble']}"
    return f"{row['name']:42} {error:26} {row['cpu_s']:6.1f} s {row['peak_mb']:6d} MB  {notes}"


def opened(path: Path) -> dict[str, Any]:
    """A table, or the rows of a run that goes on."""
    if path.suffix != ".jsonl":
        return json.loads(path.read_text(encoding="utf-8"))
    rows = list(kept(path).values())
    return {"commit": rows[0]["commit"] if rows else "none", "rows": rows}


def compare(old: Path, new: Path, floor: float, asked: Callable[[str], bool] = bool) -> int:
    """Print what changed in the rows that are asked for; 1 if one is worse."""
    pair = [opened(path) for path in (old, new)]
    pair = [result | {"rows": [row for row in result["rows"] if asked(row["name"])]} for result in pair]
    text, worse = tables.compared(pair[0], pair[1], floor)
    print(text, end="")
    return int(worse > 0)


def arguments_of(argv: list[str] | None) -> argparse.Namespace:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument(
        "--compare",
        nargs=2,
        type=Path,
        metavar=("OLD", "NEW"),
        help="compare two tables (.json), or the rows of a run that goes on (.jsonl)",
    )
    made.add_argument("--floor", type=float, default=tables.FLOOR, help="of the spread: errors below it count as that "
                      "(default %(default)g)")  # fmt: skip
    made.add_argument("--source", type=Path, help="folder that holds the package herglotz (default: of PYTHONPATH)")
    made.add_argument("--out", type=Path, help="the table (.json), or a folder for it (default benchmarks/results)")
    made.add_argument("--workers", type=int, default=int(os.environ.get("WORKERS", "2")), help="default %(default)s")
    made.add_argument("--limit", type=float, default=600, metavar="S", help="processor time of a fit (default 600 s)")
    made.add_argument("--count", type=int, default=catalogue.COUNT, metavar="N",
                      help="systems of each draw of the zoo (default %(default)s; 30 are whole draws)")  # fmt: skip
    made.add_argument("--quick", action="store_true", help="a part of every kind, five minutes of processor time")
    made.add_argument("--only", nargs="+", default=[""], metavar="WORD", help="rows whose names contain one of these")
    made.add_argument("--prepared", type=Path, default=PREPARED, help="folder for the data of rows, kept between runs")
    return made.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    arguments = arguments_of(argv)
    asked = lambda name: (  # noqa: E731
        any(word in name for word in arguments.only) and (not arguments.quick or name in catalogue.QUICK)
    )
    if arguments.compare:
        return compare(arguments.compare[0], arguments.compare[1], arguments.floor, asked)
    source = arguments.source.resolve() if arguments.source else None
    commit, out = commit_of(source), (arguments.out or harness.RESULTS).resolve()
    name = f"judge_quick_{commit}" if arguments.quick else f"judge_{commit}"
    path = out if out.suffix == ".json" else out / f"{name}.json"
    # Rows and runs stand beside a table that was asked for; the results folder of the repository has tables alone.
    beside = path.with_suffix("") if arguments.out else ROOT / "runs" / "judge" / name
    beside.mkdir(parents=True, exist_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    wanted = [row for row in catalogue.rows(arguments.count) if asked(row.name)]
    rows = kept(beside / "rows.jsonl", commit)
    judge = Judge(arguments.prepared.resolve(), beside / "work", arguments.limit, environment(source))
    measure(wanted, rows, beside / "rows.jsonl", arguments.workers, judge.row, commit)
    machine = f"{harness.processor()}, {os.cpu_count()} cores"
    result = {"commit": commit, "date": datetime.now(UTC).strftime("%Y-%m-%d"), "machine": machine}
    result |= {"limit_s": arguments.limit, "rows": [rows[row.name] for row in wanted]}
    harness.store(path, result, tables.report(result))
    print(path.with_suffix(".md"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
