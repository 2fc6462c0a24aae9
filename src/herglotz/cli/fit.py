"""`herglotz fit`: train a model on measured positions."""

from __future__ import annotations

import argparse
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from herglotz.cli.common import (
    check_output_folder,
    existing,
    exit_code,
    flag,
    import_torch,
    print_json,
    print_next_of,
    say,
)
from herglotz.cli.flags import (
    EXPERT,
    MACHINE,
    MODEL,
    OPTIMISER,
    PROGRESS,
    READING,
    RUN,
    check_run_folder,
    columns_of,
    data_of,
    progress,
    settings_of,
)

if TYPE_CHECKING:
    from herglotz.data import Trajectories
    from herglotz.training import FitConfig, Run

DESCRIPTION = """\
Train a discrete contact Lagrangian on positions; the last part of every trajectory is held out and predicted.
Metrics are printed, and RUN receives model.pt, metrics.json, config.json, fit.npz, checkpoint.pt and the figures
(*.png). The summary ends with the verdict: "fits to the noise", "fits, worse than the noise by a factor ...", or "does
not fit: ..." with what to try; then the exit code is 3.

DATA is .csv (header t[s],theta[rad],...; a column trajectory, or one that changes wherever time starts anew, groups
the rows, and a clock that falls back begins a recording), .npz (arrays t, q), a Schmidt & Lipson .txt, or with the
extra "tables" .parquet, .h5 or .mat; or a folder of such files, a recording each. Steps may differ, and samples may be
missing.

examples:
  herglotz fit pendulum.csv --out runs/pendulum
  herglotz fit another.csv --out runs/another --config runs/pendulum --seed 1
  herglotz fit loaded.csv --out runs/loaded --plan runs/pendulum
"""


# argparse's own usage, with every flag, has twenty lines.
USAGE = "%(prog)s DATA --out RUN [flag ...]"
HELP = "train a model on measured positions"
FLAGS = (
    *RUN, *PROGRESS,
    flag("--no-plots", "do not draw figures", action="store_true"),
    flag("--plan", "follow the plan of this run instead of choosing one: the same terms, from its values, as for "
         "another load", type=existing, metavar="RUN"),
    flag("--tensorboard", "log for TensorBoard, as the fit runs (RUN holds history.csv too)",
         type=Path, metavar="FOLDER"),
    *MACHINE, *READING, *MODEL, *OPTIMISER, *EXPERT,
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Read, check the output, train, save, draw, report."""
    out: Path = arguments.out
    check_run_folder(out, arguments.resume)
    import_torch()

    from herglotz.training import load_run

    config, plan = settings_of(arguments), None if arguments.plan is None else load_run(arguments.plan)
    if arguments.tensorboard is not None:
        check_output_folder(arguments.tensorboard)
    data, reading = data_of(arguments, columns_of(arguments))
    _fit_into(out, data, config, plan, reading, arguments)
    # The stored run is reported: later commands read the same, on the CPU.
    result = load_run(out)
    drawn: list[Path] = []
    if not arguments.no_plots:
        from herglotz.plots import save_figures

        drawn = save_figures(result, out)
    if arguments.json:
        print_json(result.metrics)
    else:
        report(result, out, drawn)
    return exit_code(result)


def _fit_into(
    out: Path, data: Trajectories, config: FitConfig, plan: Run | None, reading: dict[str, Any],
    arguments: argparse.Namespace,
) -> None:  # fmt: skip
    """Train and save; remove the folders that were made if the fit fails."""
    from herglotz.data.files import locked
    from herglotz.training import fit, save_run

    made = _make(out)
    try:
        with locked(out):
            shown = {"progress": progress(arguments), "tensorboard": arguments.tensorboard}
            done = fit(data, config, plan=plan, out=out, resume=arguments.resume, **shown)
            save_run(replace(done, reading=reading), out)
    except KeyboardInterrupt:
        if (out / "checkpoint.pt").exists():
            raise KeyboardInterrupt("; the same command with --resume goes on") from None
        raise
    finally:
        # `rmdir` removes empty folders alone: those of a fit that failed.
        for folder in made:
            with suppress(OSError):
                folder.rmdir()


def report(result: Run, out: Path, drawn: list[Path]) -> None:
    """Print the plan, the result and the next commands."""
    from herglotz.data.units import common_unit
    from herglotz.training import Plan

    print("Plan (what was decided, and why):")
    print(Plan.from_dict(result.metrics["plan"]).table(common_unit(result.data.units)))
    print("Result:")
    print(result.summary())
    if drawn:
        say(f"Figures in {out}: {', '.join(path.name for path in drawn)}")
    print_next_of(result, out, ["report", out], ["verify", out], ["export", out, "--out", f"{out.name}.pt2"])


def _make(folder: Path) -> list[Path]:
    """Make a folder with its parents; return those that were missing, innermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing
