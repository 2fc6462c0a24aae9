"""`herglotz tune`: find the cheapest step within an error, or the most accurate step within a budget."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from herglotz.cli.common import (
    KICKS,
    check_output_folder,
    count,
    flag,
    import_torch,
    positive,
    print_json,
    print_next,
    say,
    seed,
)
from herglotz.errors import InputError

if TYPE_CHECKING:
    from herglotz.tune import Tuning

DESCRIPTION = """\
Trade speed for accuracy: measure the error and the cost of stepping RUN at several steps, with its own model and with
big-step corrections re-trained on motions of that model, in PyTorch and in C, in float64 and float32, and with large
explicit steps of a few learned kicks (one coordinate, one damping rate). Then take the cheapest setting within an
error, or the most accurate one within a budget.

The error is the error of stepping: the largest distance of a position from the run's own motion over the horizon. 95 %
of all starts keep the quoted error (with confidence 95 %); starts that had no part in the choice check it. FOLDER
receives the tuned run (for `herglotz export`, `rollout`, ...), tuned.json and tuned.png. Where kicks win, FOLDER
receives their C header kicks.h and the unchanged run.

examples:
  herglotz tune runs/pendulum --max-error 1e-3
  herglotz tune runs/pendulum --budget-us 5 --horizon 20 --out runs/fast
  herglotz export runs/fast --format c --out stepper.h
"""


HELP = "trade speed for accuracy"
FLAGS = (
    flag("source", "folder that `herglotz fit` wrote", metavar="RUN", type=Path),
    flag("--max-error", "largest error of a position, in its unit", type=positive, metavar="E"),
    flag("--budget-us", "microseconds per unit of simulated time", type=positive, metavar="C"),
    flag("--horizon", "length of the motions, in the data's unit of time (default: a typical trajectory, at most 200 "
         "steps)", type=positive, metavar="T"),
    flag("--out", "folder for the result (default: RUN/tuned)", type=Path, metavar="FOLDER"),
    flag("--multiples", "steps to try, in steps of the run, with commas (default %(default)s)",
         default="1,2,4,8", metavar="M"),
    flag("--widths", "hidden units of the re-trained corrections, with commas, or none (default %(default)s)",
         default="8,16", metavar="W"),
    flag("--kicks", "numbers of kicks in an explicit large step, with commas, or none; tried in C where the model has "
         "one coordinate and one damping rate (default %(default)s)", default="5,7", metavar="K"),
    flag("--no-c", "PyTorch only", action="store_true"),
    flag("--starts", "number of motions that choose (default %(default)s)", type=count, default=128),
    flag("--iterations", "most in a re-training (default %(default)s)", type=count, default=80),
    flag("--seed", "seed of the starts (default %(default)s)", type=seed, default=0),
    flag("--json", "print the numbers as JSON, and nothing else", action="store_true"),
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Search, save, draw and report."""
    if (arguments.max_error is None) == (arguments.budget_us is None):
        raise InputError("give either --max-error or --budget-us")
    lists: dict[str, Any] = {
        name: _whole(f"--{name}", getattr(arguments, name)) for name in ("multiples", "widths", "kicks")
    }
    if arguments.source.is_file():
        raise InputError(f"{arguments.source}: is a file; give the folder that `herglotz fit --out` wrote")
    out: Path = arguments.out or arguments.source / "tuned"
    check_output_folder(out)
    if (out / "model.pt").exists() and not (out / "tuned.json").exists():
        raise InputError(f"--out {out}: already holds a run that tune did not write; choose another folder")
    import_torch()

    from herglotz.data.files import write_atomically
    from herglotz.plots import save_figure
    from herglotz.plots.tuning import plot_tuning
    from herglotz.training import load_run, save_run
    from herglotz.tune import TuneConfig, export_kicks_c, tune

    config = TuneConfig(
        **lists, artefacts=("eager",) if arguments.no_c else ("eager", "c"), starts=arguments.starts,
        seed=arguments.seed, iterations=arguments.iterations,
    )  # fmt: skip
    found = tune(
        load_run(arguments.source), max_error=arguments.max_error, budget_us=arguments.budget_us,
        horizon=arguments.horizon, config=config,
    )  # fmt: skip
    save_run(found.tuned_run(), out)
    if found.chosen.kicks is not None:
        export_kicks_c(found.chosen.kicks, out / KICKS, found.chosen.setting.dtype)
    else:
        (out / KICKS).unlink(missing_ok=True)
    write_atomically(out / "tuned.json", (json.dumps(found.to_dict(), indent=2) + "\n").encode())
    save_figure(plot_tuning(found), out / "tuned.png")
    if arguments.json:
        print_json(found.to_dict())
    else:
        _report(found, out)
    return 0


def _whole(name: str, text: str) -> tuple[int, ...]:
    if text.strip() == "none":
        return ()
    try:
        return tuple(int(x) for x in text.split(","))
    except ValueError:
        raise InputError(f"{name} needs whole numbers with commas between them, got {text!r}") from None


def _report(found: Tuning, out: Path) -> None:
    from herglotz.tune.result import time_label

    print(found.table())
    c, own, held = found.chosen, found.own, found.held_out
    less = f"{own.us / c.us:.3g} times faster than the unchanged run"
    if found.own_in_c is not None:
        less += f", {found.own_in_c.us / c.us:.3g} times faster than the unchanged run in C"
    print(f"Chosen: {c.setting.name}: {c.us:.3g} {time_label(found.run)}")
    say(f"  {less}")
    say(
        f"  over T = {found.horizon:g}, {100 * held['share_within']:.1f} % of {held['starts']} other starts within "
        f"{held['limit']:.3g}; median {held['median']:.2g}, worst {held['worst']:.2g}"
    )
    known = {k: v for k, v in found.model_error.items() if v is not None}
    say("  the model itself, against its data: " + ", ".join(f"{k} {v:.2g}" for k, v in known.items()))
    for note in found.notes:
        say(f"  {note}")
    print(f"Figure: {out / 'tuned.png'}")
    name = "stepper.pt2" if c.setting.artefact != "c" else "stepper.h" if c.kicks is None else "kicks.h"
    print_next(["export", out, "--out", name])
