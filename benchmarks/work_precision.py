"""Error against cost of learned steppers in C: `python benchmarks/work_precision.py [--scenes a,b] [--seeds 5]`.

Two scenes over several training seeds, into headline.json and .md: learned kicks on the damped pendulum and a learned
equation on the double pendulum, in float64 and float32; beside them neural ODEs trained on the same motions (stepped by
RK4 and DOP853), and RK4, DOP853 (adaptive and with equal steps) and leapfrog on the true equations. Needs scipy. A seed
draws the training motions and the first weights of every network.

Error: largest |q − exact| at 4 times up to T, of motions from unseen starts (median, and 95 % of them), in units of q.
Cost: processor time in µs of one motion per unit of simulated time (the least of several rounds in turn). Of each
starting set the first half chooses a setting, the second half judges it; what it is compared with is the cheapest rival
that is as accurate on the judging half itself, a choice no user can make.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.work_precision_rivals import classical, equation, neural
from benchmarks.work_precision_ways import SETUPS, Timed, costs, kicks, prepare

WANTED = {"damped_pendulum": (1e-2, 1e-3, 1e-4, 2e-5), "double_pendulum": (2e-2, 5e-3, 1e-3)}  # errors of the headline
RIVALS = (
    ("neural ODE", lambda p: p["kind"].startswith("neural ODE")),
    ("DOP853", lambda p: p["kind"] == "DOP853, true equations"),
    ("DOP853, equal steps", lambda p: p["kind"] == "DOP853 fixed, true equations"),
    ("RK4", lambda p: p["kind"] == "RK4, true equations"),
    ("leapfrog", lambda p: p["kind"] == "leapfrog, true equations"),
)


def study(name: str, seeds: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Every seed's learned and neural settings and the classical ones, timed together; the ratios of each seed."""
    timed: list[Timed] = []
    seconds = []
    for seed in range(seeds):
        say(f"seed {seed}")
        case = prepare(SETUPS[name], seed)
        mine = kicks(case) + equation(case) + neural(case)
        timed += [replace(t, point={**t.point, "seed": seed}) for t in mine]
        seconds.append(case.seconds)
        if seed == 0:
            timed += classical(case)
    found = costs(timed)
    rows = {e: [chosen(found, e, w, seeds) for w in WANTED[name]] for e in ("median", "q95")}
    return {"seeds": seeds, "seconds": seconds, "rows": rows}


def chosen(points: list[dict], error: str, wanted: float, seeds: int) -> dict[str, Any]:
    """Of each seed the cheapest learned setting within `wanted` on the choosing starts; its error on the others.

    Beside it the cost of each rival (of this seed, where rivals are trained) that is no less accurate there.
    """
    rows = []
    for seed in range(seeds):
        mine = [p for p in points if p.get("seed", seed) == seed]
        good = _within([p for p in mine if p["kind"].startswith("learned")], f"choice_{error}", wanted)
        best = min(good, key=lambda p: p["us_per_time"], default=None)
        if best is None or best[error] is None:
            continue
        row = {"seed": seed, "setting": best["setting"], "error": best[error], "us_per_time": best["us_per_time"]}
        for rival, belongs in RIVALS:
            costs_ = [p["us_per_time"] for p in _within(mine, error, best[error]) if belongs(p)]
            row[rival] = min(costs_) / best["us_per_time"] if costs_ else None
        rows.append(row)
    return {"wanted": wanted, "seeds": rows}


def _within(points: list[dict], error: str, most: float) -> list[dict]:
    """Points whose error is known and at most so large."""
    return [p for p in points if p.get(error) is not None and p[error] <= most]


def study_table(name: str, result: dict[str, Any]) -> list[str]:
    """Markdown: one line a wanted error."""
    own = statistics.median(s["fit"] + s.get("kicks", 0) for s in result["seconds"])
    theirs = statistics.median(s["neural ODE"] for s in result["seconds"])
    lines = [
        "",
        f"## Headline: {name}, {result['seeds']} training seeds",
        "",
        f"Training, CPU seconds a seed: learned {own:.0f}, all neural ODEs {theirs:.0f}. "
        "Each number: median (range) over the seeds.",
    ]
    names = [n for n, _ in RIVALS]
    for error, wanted in result["rows"].items():
        rows = []
        for row in wanted:
            found = row["seeds"]
            columns = ("error", "us_per_time", *names)
            cells = [harness.spread((r[k] for r in found), ".3g", "not reached") if found else "" for k in columns]
            rows.append([f"{row['wanted']:g}", f"{len(found)} of {result['seeds']}", *cells])
        lines += ["", f"By the {'median start' if error == 'median' else '95 % start'}:", ""]
        lines += harness.table(("wanted", "seeds", "error", "µs per time", *names), rows)
    return lines


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--scenes", help="with commas (default: both)")
    parser.add_argument("--seeds", type=int, default=5, help="training seeds (default 5)")
    arguments = parser.parse_args(argv)
    path = harness.json_file(arguments, "headline")
    scenes = harness.load(path, {"scenes": {}})["scenes"]
    for name in harness.chosen(parser, arguments.scenes, SETUPS, "scene"):
        found = study(name, arguments.seeds, lambda what, name=name: print(name, what, flush=True))
        scenes[name] = found | {"measured": harness.conditions()}
        tables = [line for scene, one in scenes.items() for line in study_table(scene, one)]
        harness.store(path, {"scenes": scenes}, "\n".join(["# Cost of the others over the learned stepper's", *tables]))


if __name__ == "__main__":
    main()
