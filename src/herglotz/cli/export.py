"""`herglotz export`: a run as one file that steps without this package."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from herglotz.cli.common import check_output_file, print_json

DESCRIPTION = """\
Write the model of a run as one .pt2 file: one step (q, p, s, h) -> (q1, p1, s1, c, residual, status), any batch
size, any step. It loads with torch.export.load(FILE).module() on a machine without herglotz.
With --format c: one C99 header that steps with <math.h> alone; an example program stands at its top.

examples:
  herglotz export runs/pendulum --out pendulum.pt2
  herglotz export runs/pendulum --format c --out stepper.h
"""


def add(commands: argparse._SubParsersAction) -> None:
    """Add the subcommand."""
    parser = commands.add_parser("export", help="write a model as one file", description=DESCRIPTION)
    parser.add_argument("source", metavar="RUN", type=Path, help="folder that `herglotz fit` wrote")
    parser.add_argument("--out", required=True, type=Path, metavar="FILE", help="file to write, ending in .pt2 (C: .h)")
    parser.add_argument("--format", choices=("pt2", "c"), default="pt2", help="of the file (default %(default)s)")
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Export, load again and say what it is."""
    check_output_file(arguments.out, (".h",) if arguments.format == "c" else (".pt2",))

    from herglotz.training import load_run

    result = load_run(arguments.source)

    from herglotz.cli.states import last_fitted
    from herglotz.export import export_c, export_pt2, load_pt2
    from herglotz.export.c_header import read_metadata

    q, p, s = last_fitted(result, 0)
    metadata = {
        "names": list(result.data.names),
        "time_unit": result.data.time_unit,
        "start": {"q": q.tolist(), "p": p.tolist(), "s": float(s)},
        "metrics": result.metrics,
    }
    described: dict[str, Any] = {"h": result.h, "box": result.box, "units": result.data.units, "metadata": metadata}
    if arguments.format == "c":
        export_c(result.model, arguments.out, **described)
        found = read_metadata(arguments.out.read_text(), arguments.out)
    else:
        export_pt2(result.model, arguments.out, **described)
        found = load_pt2(arguments.out).metadata
    size = arguments.out.stat().st_size
    if arguments.json:
        print_json({"file": str(arguments.out), "bytes": size, "metadata": found})
    else:
        print(f"{arguments.out}: {size / 1024:.0f} KiB, {found['dtype']}, {found['dof']} coordinate(s), h {result.h:g}")
        if arguments.format == "c":
            print(f"Next: the example at the top of {arguments.out}, with cc -O3 -march=native")
        else:
            print(f"Next: herglotz verify {arguments.out}")
    return 0
