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
from torch import Tensor
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import harness
from herglotz.data import Trajectories, simulate
from herglotz.scenes import scene
from herglotz.training import select
from herglotz.training.selection import CANDIDATES

NOISE = 1e-3  # of the motion's size


@dataclass(frozen=True)
class CoupledMasses:
    """Two unit masses, three springs, a damper on the second one only: q̈ = −K q − D q̇, exactly by exp(hA).

    No single rate γ describes it, nor a damping of the whole by position: each joint has its own friction.
    """

    friction: tuple[float, float]
    springs: tuple[float, float, float] = (1.0, 0.6, 1.4)
    name = "coupled_masses"
    dof = 2
    coordinates = ("x", "y")
    units = ("m", "m")
    angles = (False, False)
    q_range = (-1.0, 1.0)
    v_range = (-1.0, 1.0)

    def flow(self, q: Tensor, p: Tensor, s: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(q, p) a time h later; the action is not needed for positions and is left as it is."""
        a, b, c = self.springs
        K = torch.tensor([[a + b, -b], [-b, b + c]], dtype=q.dtype)
        D = torch.diag(torch.tensor(self.friction, dtype=q.dtype))
        A = torch.cat([torch.cat([torch.zeros_like(K), torch.eye(2, dtype=q.dtype)], 1), torch.cat([-K, -D], 1)])
        y = torch.cat([q, p], -1) @ torch.linalg.matrix_exp(h * A).mT
        return y[..., :2], y[..., 2:], s

    def momentum(self, q: Tensor, v: Tensor, s: Tensor) -> Tensor:
        """Unit masses: p = v."""
        del q, s
        return v


@dataclass(frozen=True)
class Case:
    """A scene, the level that it needs, and the step at which it is sampled."""

    level: str
    what: object
    h: float


# With the step of each: thirteen to thirty-one samples a period, where there is one.
CASES = {
    "undamped pendulum": Case("conservative", scene("damped_pendulum", gamma=0.0), 0.2),
    "undamped masses": Case("conservative", CoupledMasses((0.0, 0.0)), 0.3),
    "oscillator": Case("linear", scene("damped_oscillator"), 0.2),
    "pendulum": Case("linear", scene("damped_pendulum"), 0.2),
    "parachute": Case("affine", scene("parachute"), 0.2),
    "quadratic drag": Case("affine", scene("quadratic_drag", lam=0.1), 0.2),
    "one damper": Case("forced", CoupledMasses((0.0, 0.4)), 0.3),
    "two dampers": Case("forced", CoupledMasses((0.5, 0.1)), 0.3),
}


def sampled(case: Case) -> Trajectories:
    """8 trajectories of 61 positions with noise of a thousandth of the motion's size."""
    clean = simulate(case.what, trajectories=8, steps=60, h=case.h)  # pyright: ignore[reportArgumentType]
    noise = NOISE * float((clean.q - clean.q.mean(0)).square().mean().sqrt())
    return simulate(case.what, trajectories=8, steps=60, h=case.h, noise=noise)  # pyright: ignore[reportArgumentType]


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
