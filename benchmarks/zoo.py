"""Systems that nobody tuned for: `python benchmarks/zoo.py [--open] [--draw SEED] [--count N] [--out FOLDER] [--json]`.

Each system is drawn from (SEED, index): potential, friction, inputs, step, noise and number of recordings. `herglotz
fit` runs with its default flags in a process of its own, and is judged by free runs over the unseen third of its
recordings and over three recordings from unseen starts, in multiples of the noise. Beside it: the true equation with
its numbers fitted. Rows are kept in FOLDER (runs/zoo), with the table beside them, and are not measured again at the
same commit.

`--open` draws systems that no dictionary of terms holds, and `--laws` takes six fixed ones, each exact and with 0.5 %
of noise: 20 samples of warm-up, 200 predicted steps. Beside them four learned peers, each given the processor time that
the fit took, 10 s at least: a neural ODE, a discrete forced Lagrangian net, DeLaN with friction and a Gaussian-process
Lagrangian (`--peers NAME ...` takes some of them, `--no-peers` none). A figure stands beside the table.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.zoo_systems.drawing import draw
from benchmarks.zoo_systems.learned import LEARNED, fit_learned
from benchmarks.zoo_systems.open_laws import LAWS, fixed_law
from benchmarks.zoo_systems.open_systems import open_draw
from benchmarks.zoo_systems.ours import fit_ours
from benchmarks.zoo_systems.prediction import EquationModel, MechanismModel, own_predictions, trained
from benchmarks.zoo_systems.report import (
    METHODS,
    Predictions,
    ahead,
    draw as draw_figure,
    number,
    outcome,
    relative,
    report,
    score,
    shares,
    shown,
)
from benchmarks.zoo_systems.systems import ZooSystem

NOISES = (("exact", 0.0), ("with noise", 0.005))  # of each fixed law
LEAST = 10.0  # s of processor time that a learned peer has at least


def measure(of: ZooSystem, folder: Path, limit: float, peers: Sequence[str] = tuple(LEARNED)) -> dict[str, Any]:
    """One row of the results."""
    ours = fit_ours(of, folder, limit)
    row = of.facts() | {"beyond": unseen_excess(of), "ours": ours}
    mine = number(ours["score"])
    row["outcome"] = outcome(mine, number(ours["relative"]), bool(ours["said"]))
    if of.attainable is None:
        others = {"known": lambda of: MechanismModel(of.fitted)}
    else:
        row["attainable"] = of.attainable
        others = {name: partial(fit_learned, name=name, budget=max(LEAST, ours["cpu_s"])) for name in peers}
    for name, fit in others.items():
        row[name] = peer(of, fit)
        if name != "known":
            row[f"ahead_of_{name}"] = ahead(mine, number(row[name]["score"]))
    return row


def peer(of: ZooSystem, fit: Callable[[ZooSystem], EquationModel]) -> dict[str, float | None]:
    """Errors of another method, and the processor time of its fit."""
    began = time.process_time()
    model = fit(of)
    cpu = time.process_time() - began
    return {**numbers(of, own_predictions(of, model)), "cpu_s": cpu}


def unseen_excess(of: ZooSystem) -> float:
    """How far the unseen recordings leave the range of the training positions, over the size of the motion."""
    seen = of.train.truth[:, : trained(of.train)].reshape(-1, of.mechanism.n)
    out = np.maximum(of.test.truth - seen.max(0), seen.min(0) - of.test.truth) / of.size
    return round(max(0.0, float(out.max())), 4)


def numbers(of: ZooSystem, found: Predictions) -> dict[str, float | None]:
    """Errors over the noise, of each part too, and over the size of the motion; None where a sample was not reached."""
    values = {"score": score(of, found), "relative": relative(of, found)}
    values |= {f"score_{part}": score(of, {part: pairs}) for part, pairs in found.items()}
    return {name: x if math.isfinite(x) else None for name, x in values.items()}


def line(row: dict[str, Any]) -> str:
    """A row for people."""
    errors = "  ".join(f"{name} {shown(row[name]['score']):>11}" for name in METHODS if name in row)
    return f"{row['index']:>3}  {row['outcome']:<15} {errors}  {row['ours']['cpu_s']:5.0f} s  {row['name']}"


def chosen(arguments: argparse.Namespace) -> tuple[str, str, str, dict[str, Callable[[], ZooSystem]]]:
    """Title, name of the file, flags, and what makes each system, by its name."""
    if arguments.laws:
        every = {f"{k} {word}": (k, noise) for k in range(1, len(LAWS) + 1) for word, noise in NOISES}
        some = {name: law for name, law in every.items() if law[0] in (arguments.only or [law[0]])}
        return "Six laws that no dictionary holds", "laws", "--laws", {
            name: partial(fixed_law, *law) for name, law in some.items()
        }  # fmt: skip
    make, which, file = (open_draw, "open zoo", "open") if arguments.open else (draw, "zoo", "draw")
    indices = arguments.only or range(arguments.count)
    flags = f"{'--open ' if arguments.open else ''}--draw {arguments.draw} --count {len(indices)}"
    title = f"The {which}: {len(indices)} systems drawn by seed {arguments.draw}"
    wanted = {str(index): partial(make, arguments.draw, index) for index in indices}
    return title, f"{file}_{arguments.draw}", flags, wanted


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--draw", type=int, default=1, metavar="SEED", help="which zoo (default %(default)s)")
    parser.add_argument("--open", action="store_true", help="systems that no dictionary of terms holds")
    parser.add_argument("--laws", action="store_true", help="six fixed laws of that kind instead of a draw")
    parser.add_argument("--peers", nargs="+", choices=list(LEARNED), metavar="NAME", default=list(LEARNED),
                        help=f"beside open systems (default: {', '.join(LEARNED)})")  # fmt: skip
    parser.add_argument("--no-peers", dest="peers", action="store_const", const=[], help="none of them")
    parser.add_argument("--count", type=int, default=30, metavar="N", help="systems 0 to N - 1 (default %(default)s)")
    parser.add_argument("--only", type=int, nargs="+", metavar="I", help="these systems alone")
    parser.add_argument("--limit", type=float, default=300, metavar="S", help="processor time of a fit (default 300 s)")
    parser.add_argument("--again", action="store_true", help="keep rows of other commits too")
    parser.add_argument("--json", action="store_true", help="print rows and shares as JSON, and nothing else")
    parser.set_defaults(out=harness.ROOT / "runs" / "zoo")
    arguments = parser.parse_args(argv)
    warnings.filterwarnings("ignore", category=RuntimeWarning)  # a peer that diverges overflows
    zoo, file, flags, wanted = chosen(arguments)
    path, at = harness.json_file(arguments, file), harness.commit()
    rows = harness.load(path, {})
    measured: list[dict[str, Any]] = []
    for index in wanted:
        done = index in rows and (arguments.again or rows[index]["commit"] == at)
        if not (done and (rows[index].get("attainable") is None or set(arguments.peers) <= set(rows[index]))):
            folder = path.with_suffix("") / index
            shutil.rmtree(folder, ignore_errors=True)
            row = measure(wanted[index](), folder, arguments.limit, arguments.peers)
            rows[index] = {**row, "commit": at}
            print(line(rows[index]), file=sys.stderr, flush=True)
        measured = [rows[k] for k in wanted if k in rows]
        harness.store(path, rows, report(measured, zoo, f"{flags} --limit {arguments.limit:g}"))
    if arguments.json:
        print(json.dumps({"shares": shares(measured), "rows": measured}, indent=1))
    else:
        draw_figure(measured, zoo, path.with_suffix(".png"))
        print(path.with_suffix(".md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
