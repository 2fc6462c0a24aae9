"""Does `select` choose right? Eight generated scenes, two a level: `python benchmarks/ladder.py [--scenes NAMES]`.

Each level of the ladder is needed by two scenes and offered to all eight: one that needs less must not be given more.
What `fit` finds with nothing told (`auto`) is no level, and not offered here.
Positions with a little noise; the levels, the seeds and every setting are the defaults of `select`.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from herglotz.data import Trajectories, simulate
from herglotz.scenes import Scene, scene
from herglotz.scenes.natural import natural_scene
from herglotz.training import select
from herglotz.training.selection import CANDIDATES

NOISE = 1e-3  # of the motion's size


SPRINGS = torch.tensor([[1.6, -0.6], [-0.6, 2.0]], dtype=torch.float64)  # wall 1.0 mass 0.6 mass 1.4 wall


def coupled_masses(*friction: float) -> Scene:
    """Two unit masses, three springs and a damper on each mass: q̈ = −K q − D q̇.

    No single rate γ describes it, nor a damping of the whole by position: each joint has its own friction.
    """
    dampers = SPRINGS.new_tensor(friction)
    return natural_scene(
        lambda q: 0.5 * (q @ SPRINGS * q).sum(-1), lambda q: q @ SPRINGS, 0.0,
        external=lambda q, v: -dampers * v,  # noqa: ARG005
        name="coupled_masses", description="", coordinates=("x", "y"), units=("m", "m"), parameters={},
        q_range=(-1.0, 1.0), v_range=(-1.0, 1.0), h=0.3,
    )  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A scene, the level that it needs, and the step at which it is sampled."""

    level: str
    what: Scene
    h: float


# With the step of each: thirteen to thirty-one samples a period, where there is one.
CASES = {
    "undamped pendulum": Case("conservative", scene("damped_pendulum", gamma=0.0), 0.2),
    "undamped masses": Case("conservative", coupled_masses(0.0, 0.0), 0.3),
    "oscillator": Case("linear", scene("damped_oscillator"), 0.2),
    "pendulum": Case("linear", scene("damped_pendulum"), 0.2),
    "parachute": Case("affine", scene("parachute"), 0.2),
    "quadratic drag": Case("affine", scene("quadratic_drag", lam=0.1), 0.2),
    "one damper": Case("forced", coupled_masses(0.0, 0.4), 0.3),
    "two dampers": Case("forced", coupled_masses(0.5, 0.1), 0.3),
}


def sampled(case: Case) -> Trajectories:
    """8 trajectories of 61 positions with noise of a thousandth of the motion's size."""
    clean = simulate(case.what, trajectories=8, steps=60, h=case.h)
    noise = NOISE * float((clean.q - clean.q.mean(0)).square().mean().sqrt())
    return simulate(case.what, trajectories=8, steps=60, h=case.h, noise=noise)


def table(rows: list[dict]) -> str:
    """One line a scene: held-out RMS of every level in units of q, and what was chosen."""
    levels = list(dict.fromkeys(c["level"] for row in rows for c in row["levels"]))
    cells = []
    for row in rows:
        errors = {c["level"]: c["held_out_rms"] for c in row["levels"]}
        shown = ["failed" if errors.get(level) is None else f"{errors[level]:.3g}" for level in levels]
        chosen = row["chosen"] if row["right"] else f"**{row['chosen']}**"
        cells.append([row["scene"], row["needs"], chosen, *shown, row["seeds"]])
    lines = ["# Does `select` choose right?", "", "Held-out RMS of each level, median of the seeds.", ""]
    lines += harness.table(["scene", "needs", "chosen", *levels, "seeds"], cells)
    return "\n".join([*lines, "", f"Right on {sum(row['right'] for row in rows)} of {len(rows)} scenes."])


def main(argv: list[str] | None = None) -> None:
    parser = harness.parser(__doc__)
    parser.add_argument("--scenes", help=f"with commas; default all: {','.join(CASES)}")
    parser.add_argument("--seeds", type=int, default=5, help="fits a level (default %(default)s)")
    arguments = parser.parse_args(argv)
    path = harness.json_file(arguments, "ladder")
    rows = {row["scene"]: row for row in harness.load(path, {"scenes": []})["scenes"]}
    for name in tqdm(harness.chosen(parser, arguments.scenes, CASES, "scene"), desc="scenes", disable=None):
        case, began = CASES[name], time.process_time()
        found = select(sampled(case), CANDIDATES, seeds=arguments.seeds, progress=False)
        rows[name] = {
            "scene": name, "needs": case.level, "chosen": found.chosen.level,
            "right": found.chosen.level == case.level, "seeds": arguments.seeds, "commit": harness.commit(),
            "cpu_seconds": round(time.process_time() - began, 1), "levels": [c.to_dict() for c in found.candidates],
        }  # fmt: skip
        print(f"\n{name}: needs {case.level}, chosen {found.chosen.level}\n{found.table()}", flush=True)
        ordered = [rows[key] for key in CASES if key in rows]
        harness.store(path, {**harness.conditions(), "noise": NOISE, "scenes": ordered}, table(ordered))


if __name__ == "__main__":
    main()
