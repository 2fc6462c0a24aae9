"""Error against cost, for every way to step: `python benchmarks/work_precision.py [--quick] [--scenes a,b] [--resume]`.

Eight scenes. In C: learned steppers (their own step, larger steps re-trained, several widths and depths, float64,
float32, bfloat16 weights, loose Newton; large steps of a few learned kicks), RK4, DOP853 (adaptive and with equal
steps), implicit midpoint and leapfrog on the true equations, and RK4 and DOP853 on neural ODEs trained on the same
data. In PyTorch: discrete Lagrangians of order 1 to 6, compositions, tolerance, iterations and guess of Newton, and the
learned model eager, as ONNX and under torch.compile. Needs scipy.

Error: largest |q − exact| at 4 times up to T, of motions from unseen starts (median, and 95 % of them), in units of q.
Cost: processor time in µs of one motion per unit of simulated time (the least of several rounds in turn; rules in
PyTorch: of 4 motions at once, one round), the same in steps of C leapfrog, evaluations and flops beside it.
Written: OUT.json after each scene, OUT.md, OUT.png. The two scenes of the headline over several training seeds:
`work_precision_headline.py`.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parent))
from work_precision_analytic import analytic
from work_precision_cases import prepare
from work_precision_learned import points
from work_precision_report import add_leapfrog_unit, draw, front, headline, markdown, spread_of
from work_precision_scenes import SETUPS

ROOT = Path(__file__).resolve().parents[1]


def main(argv: list[str] | None = None) -> dict:
    """Measure, write, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small fits, few settings")
    parser.add_argument("--scenes", default=None, help="with commas (default: all)")
    parser.add_argument("--resume", action="store_true", help="keep the scenes that OUT.json already holds")
    parser.add_argument("--only", choices=("analytic", "learned"), help="one half of the settings")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "work_precision.json")
    arguments = parser.parse_args(argv)
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))
    names = arguments.scenes.split(",") if arguments.scenes else list(SETUPS)
    unknown = [n for n in names if n not in SETUPS]
    if unknown:
        parser.error(f"unknown scenes {', '.join(unknown)}; choose from {', '.join(SETUPS)}")
    result = _begun(arguments)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with tqdm([n for n in names if n not in result["scenes"]], disable=None) as bar:
        for name in bar:
            began = time.process_time()

            def say(what: str, name: str = name) -> None:
                bar.set_postfix_str(f"{name}: {what}")

            found = []
            if arguments.only != "learned":
                say("rules")
                found += analytic(SETUPS[name], arguments.quick)
            notes: dict[str, Any] = {}
            if arguments.only != "analytic":
                say("fit")
                case = prepare(SETUPS[name], arguments.quick)
                found += points(case, arguments.quick, say)
                notes = {"seconds": case.seconds, "one_step_rms": case.run.metrics["one_step_rms"]}
                result["headline"][name] = {error: headline(found, error) for error in ("median", "q95")}
            result["scenes"][name] = found
            notes |= {"T": SETUPS[name].T, "h": SETUPS[name].h, "spread": spread_of(found)}
            result["notes"][name] = {**notes, "total_seconds": time.process_time() - began}
            _write(result, arguments.out)
    for name in names:
        print(f"{name}: the front")
        for p in front(result["scenes"][name]):
            print(f"  {p['us_per_time']:>10.3g} µs/time  {p['median']:>8.2g}  {p['kind']}: {p['setting']}")
    return result


def _begun(arguments: argparse.Namespace) -> dict[str, Any]:
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=ROOT).stdout
    machine = {"processor": platform.machine(), "cores": os.cpu_count(), "threads": torch.get_num_threads()}
    result: dict[str, Any] = {
        "commit": commit.strip(), "machine": machine, "torch": torch.__version__, "quick": arguments.quick,
        "scenes": {}, "headline": {}, "notes": {},
    }  # fmt: skip
    if arguments.resume and arguments.out.exists():
        old = json.loads(arguments.out.read_text())
        result |= {k: old[k] for k in ("scenes", "headline", "notes")}
    return result


def _write(result: dict[str, Any], out: Path) -> None:
    order = {name: result["scenes"][name] for name in SETUPS if name in result["scenes"]}
    result["scenes"] = order
    add_leapfrog_unit(result)
    partial = out.with_suffix(".part")
    partial.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    partial.replace(out)
    out.with_suffix(".md").write_text(markdown(result))
    draw(order, out.with_suffix(".png"))


if __name__ == "__main__":
    main()
