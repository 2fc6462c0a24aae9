"""Error against cost of learned steppers in C: `python benchmarks/work_precision.py [--scenes a,b]`.

Of eight scenes the fitted model, and the same data with terms more and less: error and cost of a step of each.
Written after each scene, beside those of earlier runs: work_precision.json and .md. `--page` only puts the table into
docs/work_precision.md, where it stands between `<!-- terms -->` and `<!-- /terms -->`; nothing there is typed in.

Error: largest |q − exact| at 4 times up to T, of motions from unseen starts (median, and 95 % of them), in units of q.
Cost: processor time in µs of one motion per unit of simulated time (the least of several rounds in turn).

`--headline` measures two scenes over several training seeds instead, into headline.json and .md: learned kicks on the
damped pendulum and a learned equation on the double pendulum, in float64 and float32; beside them neural ODEs trained
on the same motions (stepped by RK4 and DOP853), and RK4, DOP853 (adaptive and with equal steps) and leapfrog on the
true equations. Needs scipy. A seed draws the training motions and the first weights of every network. Of each
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

from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from benchmarks.work_precision_rivals import classical, equation, neural
from benchmarks.work_precision_ways import SETUPS, TOLD, Timed, costs, kicks, learned, prepare

PAGE = harness.ROOT / "docs" / "work_precision.md"
WANTED = {"damped_pendulum": (1e-2, 1e-3, 1e-4, 2e-5), "double_pendulum": (2e-2, 5e-3, 1e-3)}  # errors of the headline
RIVALS = (
    ("neural ODE", lambda p: p["kind"].startswith("neural ODE")),
    ("DOP853", lambda p: p["kind"] == "DOP853, true equations"),
    ("DOP853, equal steps", lambda p: p["kind"] == "DOP853 fixed, true equations"),
    ("RK4", lambda p: p["kind"] == "RK4, true equations"),
    ("leapfrog", lambda p: p["kind"] == "leapfrog, true equations"),
)


# What a fit with another set of terms lacks or has besides, where its label does not say it.
CHANGED = {"level conservative": "no damping", "level linear": "one rate, no drag",
           "level affine": "drag besides, with its network"}  # fmt: skip
TERMS = {
    "damped_oscillator": "K, V quadratic, γ, correction",
    "damped_pendulum": "K, V network, γ, correction",
    "double_pendulum": "K(q) network, V network, γ, correction",
    "parachute": "K, V, γ, λ, drag network, correction",
    "kepler": "K, V of r, γ, correction",
    "chain": "K, V of stretches, γ",
    "driven_pendulum": "K, V network, γ, friction, input, correction",
    "rigid_body": "K(q) network, V network, γ, correction",
}


def markdown(result: dict[str, Any]) -> str:
    """The results file."""
    measured = f"Commit {result['commit']}, {result['machine']['cores']} cores, one thread."
    return "\n".join(["# What a term costs and brings", "", measured, "", *terms(result["scenes"])])


def terms(scenes: dict[str, list[dict]]) -> list[str]:
    """Each scene's own model at the step of its data, the first point, and what other terms cost and bring."""
    rows = []
    for name, (own, *others) in scenes.items():
        rows.append([f"**{name}**", f"**{TERMS[name]}**", f"{own['us_per_time'] * own['h']:.2g}", _error(own), ""])
        for p in others:
            label = p["kind"].removeprefix("learned, ")
            worse = f"{p['median'] / own['median']:.2g}" if p["median"] and own["median"] else "–"
            # A stored point that has no C was stepped by PyTorch.
            cost = f"{p['us_per_time'] * p['h']:.2g}{' (PyTorch)' if p['artefact'] == 'eager' else ''}"
            times = f"{p['us_per_time'] / own['us_per_time']:.2g}, {worse}"
            rows.append(["", CHANGED.get(label, label), cost, _error(p), times])
    head = ("scene", "terms", "µs a step", "median error", "times the scene's own: cost, error")
    return harness.table(head, rows)


def _error(p: dict) -> str:
    return "fails" if p["median"] is None else f"{p['median']:.2g}"


def study(name: str, seeds: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Every seed's learned and neural settings and the classical ones, timed together; the ratios of each seed."""
    setup = SETUPS[name]
    if name == "double_pendulum":
        setup = replace(setup, fit={**setup.fit, **TOLD})
    timed: list[Timed] = []
    seconds = []
    for seed in range(seeds):
        say(f"seed {seed}")
        case = prepare(setup, seed)
        mine = kicks(case) + equation(case) + neural(case)
        timed += [replace(t, point={**t.point, "seed": seed}) for t in mine]
        seconds.append(case.seconds)
        if seed == 0:
            timed += classical(case)
    found = costs(timed)
    rows = {e: [chosen(found, e, w, seeds) for w in WANTED[name]] for e in ("median", "q95")}
    return {"seeds": seeds, "seconds": seconds, "rows": rows, "points": found}


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


def measure_headline(path: Path, names: list[str], seeds: int) -> None:
    """Two scenes over several seeds, into headline.json and .md; the points themselves are not stored."""
    scenes = harness.load(path, {"scenes": {}})["scenes"]
    for name in names:
        found = study(name, seeds, lambda what, name=name: print(name, what, flush=True))
        scenes[name] = {k: v for k, v in found.items() if k != "points"} | {"measured": harness.conditions()}
        tables = [line for scene, one in scenes.items() for line in study_table(scene, one)]
        harness.store(path, {"scenes": scenes}, "\n".join(["# Cost of the others over the learned stepper's", *tables]))


def measure_scene(name: str, result: dict[str, Any], say: Callable[[str], None]) -> None:
    """The models of a scene, into the result."""
    say("fit")
    timed = learned(prepare(SETUPS[name]))
    say("timing")
    result["scenes"][name] = costs(timed)


def page() -> str:
    """docs/work_precision.md with the table of terms as the stored results have it."""
    begin, end = "<!-- terms -->\n", "<!-- /terms -->\n"
    before, rest = PAGE.read_text().split(begin)
    lines = terms(harness.load(harness.RESULTS / "work_precision.json", {})["scenes"])
    return before + begin + "\n".join(lines) + "\n" + end + rest.split(end)[1]


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--scenes", help="with commas (default: all)")
    parser.add_argument("--headline", action="store_true", help="two scenes, several training seeds")
    parser.add_argument("--seeds", type=int, default=5, help="training seeds of the headline (default 5)")
    parser.add_argument("--page", action="store_true", help="only write the table of terms into the page")
    arguments = parser.parse_args(argv)
    if arguments.page:
        PAGE.write_text(page())
        return
    names = harness.chosen(parser, arguments.scenes, WANTED if arguments.headline else SETUPS, "scene")
    path = harness.json_file(arguments, "headline" if arguments.headline else "work_precision")
    if arguments.headline:
        measure_headline(path, names, arguments.seeds)
        return
    result = {**harness.conditions(), "scenes": harness.load(path, {"scenes": {}})["scenes"]}
    with tqdm(names, disable=None) as bar:
        for name in bar:
            measure_scene(name, result, lambda what, name=name: bar.set_postfix_str(f"{name}: {what}"))
            result["scenes"] = {name: result["scenes"][name] for name in SETUPS if name in result["scenes"]}
            harness.store(path, result, markdown(result))


if __name__ == "__main__":
    main()
