"""Make the bundled sets again: `python data/generate.py [folder]`. Prints the sha256 that README.md lists."""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

from herglotz.data import Trajectories, simulate, write_csv
from herglotz.errors import InputError
from herglotz.scenes import scene

HERE = Path(__file__).parent
DEMO_COMMENTS = (
    "Generated, not measured: python data/generate.py (MIT licence, like the repository).",
    "Damped pendulum, theta'' = -sin(theta) - 0.2 theta'. The reference flow every 0.1 s, 161 samples a trajectory,",
    "then 2 gaps of 1 to 3 missing samples in each and Gaussian noise of 0.003 rad. Seed 1. Positions only.",
)


def demo_pendulum() -> Trajectories:
    """Return four noisy motions of the damped pendulum, with gaps."""
    return simulate(scene("damped_pendulum"), trajectories=4, steps=160, h=0.1, noise=0.003, gaps=2, seed=1)


def generate(folder: Path) -> dict[str, str]:
    """Write every bundled set into `folder`; return the sha256 of each file."""
    write_csv(folder / "demo_pendulum.csv", demo_pendulum(), comments=DEMO_COMMENTS)
    return {"demo_pendulum.csv": hashlib.sha256((folder / "demo_pendulum.csv").read_bytes()).hexdigest()}


if __name__ == "__main__":
    try:
        for name, sha256 in generate(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE).items():
            print(f"{sha256}  {name}")
    except InputError as error:
        sys.exit(f"{error}")
