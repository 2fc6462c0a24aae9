"""Write the data and the job of a row: `python -m benchmarks.judging.make ROW FOLDER`; exit code 4: data are absent."""

from __future__ import annotations

import sys
import warnings
from importlib import import_module
from pathlib import Path

from benchmarks.harness import Absent
from benchmarks.judging import job
from benchmarks.judging.catalogue import named

# Exit code if this machine has no such data.
ABSENT = 4


def main(name: str, folder: str) -> int:
    """Write the job, or the reason for which there is none on stderr."""
    row, home = named(name), Path(folder)
    module, function = row.maker.split(":")
    home.mkdir(parents=True, exist_ok=True)
    # Draws that diverge overflow.
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    try:
        job.write(
            Path(folder), getattr(import_module(f"benchmarks.judging.{module}"), function)(Path(folder), *row.given)
        )
    except Absent as reason:
        print(reason, file=sys.stderr)
        return ABSENT
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
