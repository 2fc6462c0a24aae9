"""The two scenes of the headline, several training seeds: `python benchmarks/work_precision_headline.py --seeds 5`.

Learned kicks on the damped pendulum, a learned equation on the double pendulum, beside neural ODEs trained on the same
motions and what is best on the true equations, all in C.

A seed draws the training motions, the first weights of every network and of every neural ODE. Of each starting set the
first half chooses a setting, the second half judges it; what it is compared with is the cheapest rival that is as
accurate on the judging half itself, a choice no user can make.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).resolve().parent))
from work_precision_cases import TIMED, Case, Timed, costs, motions_of, prepare, repeated, rolled
from work_precision_native import FLOPS, Native
from work_precision_report import RIVALS
from work_precision_rivals import classical, neural
from work_precision_scenes import CHECKS, SETUPS, TOLD, Setup, judged

from herglotz.stepping import State
from herglotz.tune.distil import pairs_of
from herglotz.tune.kick_composition import can_kick, fit_kicks
from herglotz.tune.kick_composition_c import CompiledKicks

ROOT = Path(__file__).resolve().parents[1]
WANTED = {"damped_pendulum": (1e-2, 1e-3, 1e-4, 2e-5), "double_pendulum": (2e-2, 5e-3, 1e-3)}


def kicks(case: Case, quick: bool) -> list[Timed]:
    """Steps of several h as a few learned kicks and drifts."""
    setup = case.setup
    if not setup.kick_steps or not can_kick(case.run.model):
        return []
    states, found, began = motions_of(case), [], time.process_time()
    for m in setup.kick_steps[:1] if quick else setup.kick_steps:
        if round(setup.T / setup.h) % (m * CHECKS):
            continue
        before, after = pairs_of(states, m, 1000, case.seed)
        h = m * setup.h
        least = max(2, round(1.5 * h))
        for count in range(least, least + (1 if quick else 5 if m > 3 else 4)):
            stepper = fit_kicks(case.run.model, before, after, h, kicks=count, iterations=30 if quick else 150)
            for dtype in ("float64", "float32"):
                compiled, number = CompiledKicks(stepper, dtype), getattr(torch, dtype)
                point = {"kind": "learned kicks", "setting": f"{count} kicks, h {h:.4g}, C {dtype}", "dtype": dtype}
                work = {"evaluations_per_time": count / h, "flops_per_time": count * 70 / h, "h": h, "artefact": "C"}
                steps = round(setup.T / h)
                start = State(*(x[:TIMED].to(number) for x in case.entry))
                outputs = [torch.empty(len(start.s), steps + 1, dtype=number) for _ in range(3)]
                call, times = repeated(compiled.call(start, steps, outputs), keep=outputs)
                one = {**point, **rolled(case, compiled, h, number), **work}
                found.append(Timed(one, call, times * len(start.s) * setup.T))
    case.seconds["kicks"] = time.process_time() - began
    return found


def equation(case: Case) -> list[Timed]:
    """RK4 and DOP853 on the *learned* Lagrangian's own Herglotz equation, in C: no contact map, nothing is solved.

    For two links told as such; the entry is the learned model's, from two positions.
    """
    setup, model = case.setup, case.run.model
    if setup.name != "double_pendulum" or not case.run.config.features:
        return []
    constants, found = constants_of(model), []
    y = torch.cat([case.entry.q, _velocity(constants, case.entry)], -1)
    for dtype in ("float64", "float32"):
        library = Native(setup.name, dtype, dof=2, constants=constants)
        for method, sizes in (("RK4", (4, 5, 6, 7, 8, 10, 12, 16)), ("DOP853 fixed", (2, 3, 4))):
            for x in sizes:
                q, count = library.motions(y, setup.T, CHECKS, method, x)
                call, times = repeated(library.call(y[:TIMED], setup.T, CHECKS, method, x))
                h, each = setup.T / CHECKS / x, count / len(y) / setup.T
                words = {"RK4": "RK4", "DOP853 fixed": "DOP853, equal steps"}[method]
                point = {"kind": "learned equation", "setting": f"{words}, h {h:.3g}, C {dtype}", "dtype": dtype}
                work = {"evaluations_per_time": each, "flops_per_time": each * FLOPS[setup.name], "h": h}
                one = {**point, **judged(q, case.truth), **work, "artefact": "C"}
                found.append(Timed(one, call, times * TIMED * setup.T))
    return found


def constants_of(model: Any) -> dict[str, float]:
    """The learned numbers of K = (M00 v0² + 2(M01 + MC cos(q0 − q1)) v0 v1 + M11 v1²)/2, V = −G0 cos q0 − G1 cos q1."""
    with torch.no_grad():
        K, base = model.kinetic, model.kinetic.base.mass()
        V = {tuple(x.form): w for x, w in _waves(model)}
        found = {"M00": base[0, 0], "M01": base[0, 1], "MC": K.sum.weights()[0], "M11": base[1, 1]}
        found |= {"G0": -V[(1.0, 0.0)], "G1": -V[(0.0, 1.0)], "RATE": model.damping.rate}
        return {k: float(x) for k, x in found.items()}


def _waves(model: Any) -> list[tuple[Any, Tensor]]:
    """The cosines of V with their weights; sines, which are none by symmetry, are left out."""
    c = model.potential.features.sum
    return [(p, w) for p, w in zip(c.products, c.weights(), strict=True) if p.function == "cos"]


def _velocity(constants: dict[str, float], state: State) -> Tensor:
    m = constants["M01"] + constants["MC"] * torch.cos(state.q[:, 0] - state.q[:, 1])
    a, b = torch.full_like(m, constants["M00"]), torch.full_like(m, constants["M11"])
    M = torch.stack([torch.stack([a, m], -1), torch.stack([m, b], -1)], -2)
    return torch.linalg.solve(M, state.p)


def study(name: str, seeds: int, quick: bool, say: Callable[[str], None]) -> dict[str, Any]:
    """Every seed's learned and neural settings and the classical ones, timed together; the ratios of each seed."""
    setup: Setup = SETUPS[name]
    if name == "double_pendulum":
        setup = replace(setup, fit={**setup.fit, **TOLD})
    timed: list[Timed] = []
    seconds = []
    for seed in range(seeds):
        say(f"seed {seed}")
        case = prepare(setup, quick, seed)
        mine = kicks(case, quick) + equation(case) + neural(case, quick)
        timed += [Timed({**t.point, "seed": seed}, t.run, t.time, t.idle) for t in mine]
        seconds.append(case.seconds)
        if seed == 0:
            timed += classical(case)
    found = costs(timed, 3 if quick else 9)
    rows = {e: [chosen(found, e, w, seeds) for w in WANTED[name]] for e in ("median", "q95")}
    return {"seeds": seeds, "seconds": seconds, "rows": rows, "points": found}


def chosen(points: list[dict], error: str, wanted: float, seeds: int) -> dict[str, Any]:
    """Of each seed the cheapest learned setting within `wanted` on the choosing starts; its error on the others.

    Beside it the cost of each rival (of this seed, where rivals are trained) that is no less accurate there.
    """
    rows = []
    for seed in range(seeds):
        mine = [p for p in points if p.get("seed", seed) == seed]
        good = [p for p in mine if p["kind"].startswith("learned")]
        good = [p for p in good if p[f"choice_{error}"] is not None and p[f"choice_{error}"] <= wanted]
        best = min(good, key=lambda p: p["us_per_time"], default=None)
        if best is None or best[error] is None:
            continue
        row = {"seed": seed, "setting": best["setting"], "error": best[error], "us_per_time": best["us_per_time"]}
        for rival, belongs in RIVALS:
            costs_ = [p["us_per_time"] for p in mine if belongs(p) and p[error] is not None and p[error] <= best[error]]
            row[rival] = min(costs_) / best["us_per_time"] if costs_ else None
        rows.append(row)
    return {"wanted": wanted, "seeds": rows}


def middle(values: list[float | None]) -> str:
    """Median and range, or how many never get there."""
    known = [v for v in values if v is not None]
    if not known:
        return "not reached"
    text = f"{statistics.median(known):.3g} ({min(known):.3g} … {max(known):.3g})"
    return text if len(known) == len(values) else f"{text}, not reached by {len(values) - len(known)}"


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
    for error, rows in result["rows"].items():
        lines += ["", f"By the {'median start' if error == 'median' else '95 % start'}:", ""]
        lines += [f"| wanted | seeds | error | µs per time | {' | '.join(names)} |", "|" + "---|" * (4 + len(names))]
        for row in rows:
            found = row["seeds"]
            if not found:
                lines.append(f"| {row['wanted']:g} | 0 of {result['seeds']} |" + " |" * (2 + len(names)))
                continue
            cells = [middle([r[k] for r in found]) for k in ("error", "us_per_time", *names)]
            lines.append(f"| {row['wanted']:g} | {len(found)} of {result['seeds']} | {' | '.join(cells)} |")
    return lines


def main(argv: list[str] | None = None) -> None:
    """Measure, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small fits, few settings")
    parser.add_argument("--seeds", type=int, default=5, help="training seeds (default 5)")
    parser.add_argument("--scenes", default=",".join(WANTED), help="with commas (default %(default)s)")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "headline.json")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    names = arguments.scenes.split(",")
    if unknown := [n for n in names if n not in WANTED]:
        parser.error(f"unknown scenes {', '.join(unknown)}; choose from {', '.join(WANTED)}")
    result = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"scenes": {}}
    for name in names:
        found = study(name, arguments.seeds, arguments.quick, lambda what, n=name: print(n, what, flush=True))
        result["scenes"][name] = found | {"measured": _where()}
        write(result, arguments.out)


def _where() -> dict[str, Any]:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT).stdout
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "threads": torch.get_num_threads()}
    return {"commit": commit.strip(), "torch": torch.__version__, "machine": machine}


def write(result: dict[str, Any], out: Path) -> None:
    """OUT.json and OUT.md."""
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = out.with_suffix(".part")
    partial.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    partial.replace(out)
    tables = [line for name, found in result["scenes"].items() for line in study_table(name, found)]
    out.with_suffix(".md").write_text("\n".join(["# Cost of the others over the learned stepper's", *tables, ""]))


if __name__ == "__main__":
    main()
