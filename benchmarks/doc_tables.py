"""Put the table of benchmarks/results/work_precision.json into docs/work_precision.md; nothing is typed in.

`python benchmarks/doc_tables.py`. The table stands between `<!-- terms -->` and `<!-- /terms -->`.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.work_precision import terms

PAGE = harness.ROOT / "docs" / "work_precision.md"


def filled() -> str:
    """The page with the table as the stored results have it."""
    begin, end = "<!-- terms -->\n", "<!-- /terms -->\n"
    before, rest = PAGE.read_text().split(begin)
    lines = terms(harness.load(harness.RESULTS / "work_precision.json", {})["scenes"])[3:]
    return before + begin + "\n".join(lines) + "\n" + end + rest.split(end)[1]


if __name__ == "__main__":
    PAGE.write_text(filled())
