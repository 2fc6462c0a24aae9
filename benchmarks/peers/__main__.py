"""herglotz beside its peers, on the same data and machine: `python benchmarks/peers [--data ...] [--peers ...]`.

A cell is one fit: a data set, a peer, what it is given, a seed. Every finished cell is kept in peers.json at once; the
command goes on where it was interrupted, and `--again` measures some peers anew. At the end (or with `--redraw` alone)
peers.md and peers.png are written.

Data: pendulum_02, pendulum_05, pendulum_10 (simulated damped pendulum at three steps), pendulum_noise, pendulum_one
(one trajectory), double_pendulum, real_pendulum and ibm (measured; data/README.md says where to get them).

Examples
--------
    python benchmarks/peers --data pendulum_05 --peers ours,hnn,sindy --seeds 2 --budget 5 --out runs/peers
    python benchmarks/peers --redraw               # table and figure from the JSON that is there

Needs, each for its peer alone: torchdiffeq, pysindy, phlearn (`pip install --no-deps phlearn imageio`, then ipython and
autograd). A peer whose package is missing is left out, and the command says so.
"""

from __future__ import annotations

import signal
import sys
import time
from pathlib import Path
from typing import Any

from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from benchmarks import harness
from benchmarks.peers import PEERS, networks
from benchmarks.peers.problems import PROBLEMS, Problem
from benchmarks.peers.report import draw, table
from herglotz.errors import InputError

BUDGET = 10.0  # seconds of processor time of a network peer's fit
LIMIT = 900  # seconds of processor time after which a cell is given up


def _out_of_time(*_: Any) -> None:
    raise TimeoutError


def cell(problem: Problem, name: str, given: str, seed: int, budget: float) -> dict[str, Any]:
    """Train and judge; what goes wrong is part of the result."""
    peer, exact = PEERS[name], given == "exact"
    signal.signal(signal.SIGVTALRM, _out_of_time)
    signal.setitimer(signal.ITIMER_VIRTUAL, LIMIT)
    began = time.process_time()
    out: dict[str, Any] = {"error": None, "commit": harness.commit()}
    try:
        if name == "ours" and problem.own is not None:
            found, out["parameters"] = problem.own(seed)
            return out | found | {"seconds": time.process_time() - began}
        samples = problem.samples(seed, exact)
        began = time.process_time()  # simulating the data is not training
        model = peer.train(samples, seed, budget)
        out |= {"seconds": time.process_time() - began, "parameters": model.parameters}
        return out | problem.judge(model, exact)
    except TimeoutError:
        error = f"not done in {LIMIT} s"
    except (RuntimeError, ValueError, ArithmeticError, InputError) as problem_met:
        error = f"{type(problem_met).__name__}: {str(problem_met).splitlines()[0][:80]}"
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    out.setdefault("seconds", time.process_time() - began)
    return out | {"error": error, "rms": None}


def settings(budget: float) -> dict[str, Any]:
    """What every network peer shares."""
    names = ("WIDTH", "BATCH", "LEARNING_RATE", "ADAM_PART", "PATIENCE")
    return {"budget_s": budget, **{name.lower(): getattr(networks, name) for name in names}, "dtype": "float64"}


def opened(path: Path, budget: float | None) -> dict[str, Any]:
    """The result so far, or an empty one."""
    new = harness.conditions("numpy", "scipy", "torchdiffeq", "pysindy", "phlearn")
    result = harness.load(path, new | {"settings": settings(budget or BUDGET), "titles": {}, "cells": {}})
    if result["settings"] != settings(budget or result["settings"]["budget_s"]):
        raise InputError(
            f"{path}: holds results of other settings, {result['settings']}; take that --budget, or another --out"
        )
    return result


def plan(data: list[str], peers: list[str], seeds: int) -> list[tuple[str, str, str, int]]:
    """All cells, seed by seed: an interrupted run has every data set and peer."""
    cells = []
    for seed in range(seeds):
        for name in data:
            problem = PROBLEMS[name]()
            simulated = problem.simulated
            for peer in peers:
                needs = PEERS[peer].needs
                given = ["differences" if needs == "velocities" else "positions"]
                if needs != "positions" and simulated:
                    given.append("exact")
                cells += [(name, peer, one, seed) for one in given]
    return cells


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--data", help=f"with commas (default: all of {', '.join(PROBLEMS)})")
    parser.add_argument("--peers", help=f"with commas (default: all of {', '.join(PEERS)})")
    parser.add_argument("--seeds", type=int, default=5, help="seeds 0, 1, … of data and weights (default 5)")
    parser.add_argument("--budget", type=float, help=f"seconds of processor time a network fit (default {BUDGET:g})")
    parser.add_argument("--again", action="store_true", help="measure the chosen cells anew")
    parser.add_argument("--redraw", action="store_true", help="only the table and the figure")
    arguments = parser.parse_args(argv)
    data = harness.chosen(parser, arguments.data, PROBLEMS, "data set")
    peers = harness.chosen(parser, arguments.peers, PEERS, "peer")
    for name in [p for p in peers if not PEERS[p].installed]:
        print(f"{name}: left out, {PEERS[name].package} is not installed", file=sys.stderr)
        peers.remove(name)
    path = harness.json_file(arguments, "peers")
    try:
        result = opened(path, arguments.budget)
        if not arguments.redraw:
            measure(result, plan(data, peers, arguments.seeds), arguments.again, path)
    except InputError as error:
        raise SystemExit(f"error: {error}") from None
    harness.store(path, result, table(result))
    draw(result, path.with_suffix(".png"))
    print(path.with_suffix(".md"))


def measure(result: dict[str, Any], cells: list[tuple[str, str, str, int]], again: bool, path: Path) -> None:
    """Fit and judge the cells that the result does not hold, or all; each is stored at once."""
    keys = {"/".join(map(str, c)): c for c in cells}
    todo = {k: c for k, c in keys.items() if again or k not in result["cells"]}
    with tqdm(todo.items(), initial=len(keys) - len(todo), total=len(keys), disable=None) as bar:
        for key, (name, peer, given, seed) in bar:
            bar.set_postfix_str(key)
            problem = PROBLEMS[name]()
            result["titles"][name] = problem.title
            result["cells"][key] = cell(problem, peer, given, seed, result["settings"]["budget_s"])
            harness.store(path, result)


if __name__ == "__main__":
    main()
