"""Put the tables of benchmarks/results into the docs: `python benchmarks/doc_tables.py`; nothing is typed in.

A table stands between `<!-- NAME -->` and `<!-- /NAME -->`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
from work_precision_report import terms

from extremes import terms_table

ROOT = Path(__file__).resolve().parents[1]


def filled(text: str, name: str, lines: Sequence[str]) -> str:
    """The text with these lines between the marks of that name."""
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->\n"
    before, rest = text.split(begin)
    return before + begin + "\n".join(lines) + "\n" + end + rest.split(end)[1]


def documents() -> dict[Path, str]:
    """Each page with its table as the stored results have it."""
    results, docs = ROOT / "benchmarks" / "results", ROOT / "docs"
    levels = terms_table(json.loads((results / "extremes.json").read_text())["parts"]["terms"])
    scenes = terms(json.loads((results / "work_precision.json").read_text())["scenes"])[3:]
    tables = {docs / "extremes.md": ("levels", levels), docs / "work_precision.md": ("terms", scenes)}
    return {page: filled(page.read_text(), *table) for page, table in tables.items()}


if __name__ == "__main__":
    for page, text in documents().items():
        page.write_text(text)
