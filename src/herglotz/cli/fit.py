"""`herglotz fit`: train a model on measured positions."""

from __future__ import annotations

import argparse
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from herglotz.cli.common import count, finite, positive, print_json
from herglotz.cli.flags import add_machine_flags, add_run_flags, check_run_folder, columns_of, parse_angles

if TYPE_CHECKING:
    from herglotz.training import Run

# Copies, so that help does not import PyTorch; a test compares them.
SUPERVISION = ("q", "qs", "qps")
ROBUST = ("auto", "on", "off")
HOLDS = ("zero", "first", "smooth")
LEVELS = ("conservative", "linear", "affine", "full", "forced")
OBJECTIVES = ("auto", "residual", "trajectory", "smoothing", "raw")
OPTIMISERS = ("lm", "adam", "adamw")
DEPARTURES = (2e-4, 6e-4, 2e-3, 6e-3)
NO_FIT = 3  # exit code of a fit that does not follow its data; the run is written
DESCRIPTION = """\
Train a discrete contact Lagrangian on positions; the last part of every trajectory is held out and predicted.
Metrics are printed, and RUN receives model.pt, metrics.json, config.json, fit.npz, checkpoint.pt and the figures
(*.png). The last line is the verdict: "fits to the noise", "fits, worse than the noise by ...", or "does not fit: ..."
with what to try; then the exit code is 3.

DATA is .csv (header t[s],theta[rad],...; a column trajectory groups the rows), .npz (arrays t, q) or a
Schmidt & Lipson .txt. Steps may differ and samples may be missing.

example:
  herglotz fit pendulum.csv --out runs/pendulum
"""


def add(commands: argparse._SubParsersAction) -> None:
    """Add the subcommand; its flags stand in groups, the most used first."""
    parser = commands.add_parser("fit", help="train a model on measured positions", description=DESCRIPTION)
    add_run_flags(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress: neither a bar nor lines")
    parser.add_argument("--no-plots", action="store_true", help="do not draw figures")
    add_machine_flags(parser)
    _model_flags(parser.add_argument_group("model"))
    _optimiser_flags(parser.add_argument_group("objective and optimiser"))
    _expert_flags(parser.add_argument_group("what is known (expert)"))
    parser.set_defaults(run=run)


def _model_flags(parser: argparse._ArgumentGroup) -> None:
    """What the Lagrangian may hold."""
    parser.add_argument(
        "--level", choices=("auto", *LEVELS), default="auto",
        help="auto: forced with dry friction where inputs u are recorded, else linear; for two or three joints what "
        "the data show. conservative: no damping. linear: one damping rate. affine: damping depends on position and "
        "velocity. full: on s as well. forced: one rate, and friction of each joint (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--order", type=int, choices=(2, 4), default=2,
        help="of the rule; 4: from the features alone, without networks (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--sticking", action=argparse.BooleanOptionalAction, default=None,
        help="dry friction that can hold a joint still (forced); default: where driven data show it",
    )  # fmt: skip
    parser.add_argument(
        "--term", action="append", default=[], metavar="NAME", help="a term of herglotz.models.TERMS; may be repeated"
    )
    parser.add_argument("--coupled", action="store_true", help="friction of differences of speeds: hinges (forced)")
    parser.add_argument("--diagonal", action="store_true", help="a mass for each coordinate, none between two: bodies")
    parser.add_argument("--alike", action="store_true", help="one mass for all, a potential of features alone: chains")


def _optimiser_flags(parser: argparse._ArgumentGroup) -> None:
    """How it is fitted."""
    parser.add_argument(
        "--objective", choices=OBJECTIVES, default="auto",
        help="residual: one-step error, for exact data. trajectory: whole trajectories, for noisy data. smoothing: "
        "every state, and a little noise in every step, for pushes and chaos. auto: the first or the "
        "second, by the noise. raw: a plain network on |R|, which collapses, for demonstration (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--optimiser", choices=OPTIMISERS, default="lm",
        help="lm: Levenberg–Marquardt. adam, adamw: for residual and raw only (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--batch", type=count, metavar="B", help="triples of samples in a step of adam or adamw (default: all)"
    )
    parser.add_argument(
        "--robust", choices=ROBUST, default="auto",
        help="a loss that outliers cannot pull, and spikes left out. auto: where the data show outliers "
        "(default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--supervision", choices=SUPERVISION, default="q",
        help="what the one-step objective is fitted to: positions, s beside them, or momenta as well, where they are "
        "recorded (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--restarts", type=count, metavar="R",
        help="random initialisations of the one-step fit; the best after 30 iterations is kept (default: 4 for a "
        "correction of one layer, else 1)",
    )  # fmt: skip
    parser.add_argument(
        "--substeps", type=count, default=1, metavar="M",
        help="model steps in a recorded step, for samples far apart; with --objective trajectory (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--every", type=count, default=1, metavar="M",
        help="use every M-th sample only; inputs are averaged over the steps (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--iterations", type=count, default=400, metavar="K",
        help="bound on the iterations of the one-step objectives (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--departures", type=positive, nargs="+", metavar="TAU", default=DEPARTURES,
        help="prior strengths on the networks that held-out blocks choose from; one fixes it (default: 2e-4 to 6e-3)",
    )  # fmt: skip


def _expert_flags(parser: argparse._ArgumentGroup) -> None:
    """What the user knows of the system."""
    parser.add_argument(
        "--feature", action="append", default=[], metavar="TEXT",
        help="what L = K - V may hold beside its terms, its coefficient learned: 'cos(q1 - q2) v1 v2' (of K), "
        "'cos(2q1)' (of V), or a list by name (chain, sites, central, pendulums, harmonics, revolute, lengths); may be "
        "given again",
    )  # fmt: skip
    parser.add_argument(
        "--known", action="append", default=[], metavar="TEXT",
        help="what is known of L = K - V, with its numbers (the first mass is 1): --known='-9.81 cos(q1)' is a "
        "pendulum's V: no velocity is in it. May be given again",
    )  # fmt: skip
    parser.add_argument(
        "--drag", action="append", default=[], metavar="TEXT",
        help="a friction force beside the viscous one, its coefficient learned: '|v1| v1', 'q1^2 v1', 'v1^3', or a "
        "constant one, 'load 1' (forced); may be given again",
    )  # fmt: skip
    parser.add_argument("--ignore-inputs", action="store_true", help="fit as if no input u were recorded")
    parser.add_argument(
        "--input-map", type=finite, nargs="+", default=(), metavar="G",
        help="the map from inputs to forces, row by row, where it is known (default: learned); the first mass is 1",
    )  # fmt: skip
    parser.add_argument(
        "--hold", choices=HOLDS,
        help="what the inputs do between samples: nothing, straight lines, or cubics (default: what the file says, or "
        "what explains the data best)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Read, check the output, train, save, draw, report."""
    out: Path = arguments.out
    check_run_folder(out, arguments.resume)

    from herglotz.data import load
    from herglotz.training import FitConfig, fit, load_run, save_run

    config = FitConfig(
        level=arguments.level, objective=arguments.objective, optimiser=arguments.optimiser,
        train_fraction=arguments.train_fraction, seed=arguments.seed, dtype=arguments.dtype, device=arguments.device,
        robust=arguments.robust, supervision=arguments.supervision, restarts=arguments.restarts, batch=arguments.batch,
        use_inputs=not arguments.ignore_inputs, input_map=tuple(arguments.input_map),
        features=tuple(arguments.feature), known=tuple(arguments.known), terms=tuple(arguments.term),
        alike=arguments.alike, diagonal=arguments.diagonal, coupled=arguments.coupled, sticking=arguments.sticking,
        drag=tuple(arguments.drag), order=arguments.order, substeps=arguments.substeps,
        iterations=arguments.iterations, departures=tuple(arguments.departures),
    )  # fmt: skip
    data = load(arguments.data, angles=parse_angles(arguments.angles), **columns_of(arguments))
    data = replace(data, hold=arguments.hold or data.hold).thinned(arguments.every)
    made = _make(out)
    try:
        save_run(fit(data, config, out=out, resume=arguments.resume, progress=progress(arguments.quiet)), out)
    except KeyboardInterrupt:
        if (out / "checkpoint.pt").exists():
            raise KeyboardInterrupt("; the same command with --resume goes on") from None
        raise
    finally:
        for folder in made:  # innermost first; only what is empty, so only after a failure
            with suppress(OSError):
                folder.rmdir()
    result = load_run(out)  # what later commands will see, and on the cpu
    drawn = _draw(result, out) if not arguments.no_plots else []
    if arguments.json:
        print_json(result.metrics)
    else:
        report(result, out, drawn)
    return NO_FIT if result.metrics["verdict"].startswith("does not fit") else 0


def progress(quiet: bool) -> Literal[False, "lines"] | None:
    """Bars on a terminal, a line a stage elsewhere, nothing when quiet."""
    return False if quiet else None if sys.stderr.isatty() else "lines"


def report(result: Run, out: Path, drawn: list[Path]) -> None:
    """Print what was reached, for people, and what to do next."""
    from herglotz.training import Plan

    print("Plan (what was decided, and why):")
    print(Plan.from_dict(result.metrics["plan"]).table())
    print("Result:")
    print(result.summary())
    if drawn:
        print(f"Figures in {out}: {', '.join(path.name for path in drawn)}")
    print(f"Next: herglotz verify {out}")
    print(f"      herglotz export {out} --out {out.name}.pt2")


def _draw(result: Run, out: Path) -> list[Path]:
    from herglotz.plots import save_figures

    return save_figures(result, out)


def _make(folder: Path) -> list[Path]:
    """Make a folder with its parents; return those that were missing, innermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing
