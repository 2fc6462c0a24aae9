"""Systems that nobody tuned for: `python benchmarks/zoo.py [--draw SEED] [--count N] [--out FOLDER] [--json]`.

Each system is drawn from (SEED, index): potential, friction, inputs, step, noise and number of recordings. `herglotz
fit` runs with its default flags in a process of its own, and is judged by free runs over the unseen third of its
recordings and over three recordings from unseen starts, in multiples of the noise. Beside it: SINDy, and the true
equation with its numbers fitted. Rows are kept in FOLDER (runs/zoo), with the table beside them, and are not measured
again at the same commit.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.zoo_systems.drawing import draw
from benchmarks.zoo_systems.ours import fit_ours
from benchmarks.zoo_systems.peers import fit_sindy
from benchmarks.zoo_systems.prediction import MechanismModel, own_predictions, trained
from benchmarks.zoo_systems.report import Predictions, number, outcome, relative, report, score, shares, shown
from benchmarks.zoo_systems.systems import ZooSystem

KEPT = ("level", "objective", "train_rms", "extrapolation_rms", "follows_data", "verdict", "departure", "parameters")


def measure(of: ZooSystem, folder: Path, limit: float) -> dict[str, Any]:
    """One row of the results."""
    row = of.facts() | {"beyond": unseen_excess(of)}
    for name, fit in (("known", lambda of: MechanismModel(of.fitted)), ("sindy", fit_sindy)):
        began = time.process_time()
        found = own_predictions(of, fit(of))
        row[name] = {**numbers(of, found), "cpu_s": time.process_time() - began}
    ours = fit_ours(of, folder, limit)
    kept = {name: ours.metrics[name] for name in KEPT if name in ours.metrics}
    row["ours"] = {**numbers(of, ours.predictions), "cpu_s": ours.cpu, "said": ours.said, **kept}
    mine, theirs = (number(row[name]["score"]) for name in ("ours", "sindy"))
    row["outcome"] = outcome(mine, number(row["ours"]["relative"]), bool(ours.said))
    row["ahead_of_sindy"] = math.isfinite(mine) and mine <= max(theirs, 1.0)
    return row


def unseen_excess(of: ZooSystem) -> float:
    """How far the unseen recordings leave the range of the training positions, over the size of the motion."""
    seen = of.train.truth[:, : trained(of.train)].reshape(-1, of.mechanism.n)
    out = np.maximum(of.test.truth - seen.max(0), seen.min(0) - of.test.truth) / of.size
    return round(max(0.0, float(out.max())), 4)


def numbers(of: ZooSystem, found: Predictions | None) -> dict[str, float | None]:
    """Errors over the noise, of each part too, and over the size of the motion; None where a sample was not reached."""
    pair = (math.inf, math.inf) if found is None else (score(of, found), relative(of, found))
    values = dict(zip(("score", "relative"), pair, strict=True))
    values |= {f"score_{part}": score(of, {part: pairs}) for part, pairs in (found or {}).items()}
    return {name: x if math.isfinite(x) else None for name, x in values.items()}


def line(row: dict[str, Any]) -> str:
    """A row for people."""
    errors = "  ".join(f"{name} {shown(row[name]['score']):>11}" for name in ("ours", "sindy", "known"))
    return f"{row['index']:3d}  {row['outcome']:<15} {errors}  {row['ours']['cpu_s']:5.0f} s  {row['name']}"


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--draw", type=int, default=1, metavar="SEED", help="which zoo (default %(default)s)")
    parser.add_argument("--count", type=int, default=30, metavar="N", help="systems 0 to N - 1 (default %(default)s)")
    parser.add_argument("--only", type=int, nargs="+", metavar="I", help="these systems alone")
    parser.add_argument("--limit", type=float, default=300, metavar="S", help="processor time of a fit (default 300 s)")
    parser.add_argument("--again", action="store_true", help="keep rows of other commits too")
    parser.add_argument("--json", action="store_true", help="print rows and shares as JSON, and nothing else")
    parser.set_defaults(out=harness.ROOT / "runs" / "zoo")
    arguments = parser.parse_args(argv)
    warnings.filterwarnings("ignore", category=RuntimeWarning)  # a peer that diverges overflows
    path, at = harness.json_file(arguments, f"draw_{arguments.draw}"), harness.commit()
    rows = harness.load(path, {})
    wanted = [str(index) for index in arguments.only or range(arguments.count)]
    measured: list[dict[str, Any]] = []
    for index in wanted:
        if not (index in rows and (arguments.again or rows[index]["commit"] == at)):
            folder = path.with_suffix("") / index
            shutil.rmtree(folder, ignore_errors=True)
            rows[index] = {**measure(draw(arguments.draw, int(index)), folder, arguments.limit), "commit": at}
            print(line(rows[index]), file=sys.stderr, flush=True)
        measured = [rows[k] for k in wanted if k in rows]
        harness.store(path, rows, report(measured, arguments.draw, arguments.limit))
    table = path.with_suffix(".md").read_text(encoding="utf-8")
    print(json.dumps({"shares": shares(measured), "rows": measured}, indent=1) if arguments.json else table)


if __name__ == "__main__":
    main()
