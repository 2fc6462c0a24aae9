"""`herglotz report`: one HTML page that says how far to trust a run."""

from __future__ import annotations

import argparse
from pathlib import Path

from herglotz.cli.common import check_output_folder, existing, flag, import_torch
from herglotz.cli.flags import READING, columns_of

DESCRIPTION = """\
Write report.html, one self-contained page, and report.md, its words and tables: the verdict first, then the learned
equation with standard deviations, a walk through the free run, the data, the plan of the fit with its reasons, errors
on held-out time, what the data leave open, the verification, speed, and how to use the exported files.

examples:
  herglotz report runs/pendulum
  herglotz report runs/pendulum --against another.csv --out reports/pendulum
"""


HELP = "write an HTML report of a run"
FLAGS = (
    flag("source", "folder that `herglotz fit` or `select` wrote", metavar="RUN", type=Path),
    flag("--against", "another recording to score the model on", type=existing, metavar="DATA"),
    flag("--out", "folder for both files (default: RUN)", type=Path, metavar="FOLDER"),
    *READING,
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Write both files, and print their names."""
    folder = arguments.out or arguments.source
    import_torch()

    from herglotz.report import write_report
    from herglotz.training import load_run
    from herglotz.training.fitted_run import as_recorded

    result, against = load_run(arguments.source), None
    check_output_folder(folder)
    if arguments.against is not None:
        against = as_recorded(result, arguments.against, **columns_of(arguments))
    for path in write_report(result, folder, against, name=str(arguments.source)):
        print(path)
    return 0
