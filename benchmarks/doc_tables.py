"""Put the tables of benchmarks/results into the docs: `python benchmarks/doc_tables.py`; nothing is typed in.

A table stands between `<!-- NAME -->` and `<!-- /NAME -->`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.extremes import terms_table
from benchmarks.work_precision import terms


def filled(text: str, name: str, lines: Sequence[str]) -> str:
    """The text with these lines between the marks of that name."""
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->\n"
    before, rest = text.split(begin)
    return before + begin + "\n".join(lines) + "\n" + end + rest.split(end)[1]


def documents() -> dict[Path, str]:
    """Each page with its table as the stored results have it."""
    docs, stored = harness.ROOT / "docs", (harness.RESULTS / f"{name}.json" for name in ("extremes", "work_precision"))
    extremes, work_precision = (harness.load(path, {}) for path in stored)
    levels, scenes = terms_table(extremes["parts"]["terms"]), terms(work_precision["scenes"])[3:]
    tables = {docs / "extremes.md": ("levels", levels), docs / "work_precision.md": ("terms", scenes)}
    return {page: filled(page.read_text(), *table) for page, table in tables.items()}


if __name__ == "__main__":
    for page, text in documents().items():
        page.write_text(text)
