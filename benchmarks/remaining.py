"""How well a fit's bar tells the time that is left: `python -m benchmarks.remaining --draw 8817 --count 8`.

For each system of that zoo: how long its fit took by the clock, the median of what the bar said was left over what was,
the share of drawings within a factor of two of the truth, and the longest time without a drawing.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from itertools import pairwise
from statistics import median
from typing import ClassVar

from benchmarks.zoo_systems.drawing import draw
from benchmarks.zoo_systems.ours import trajectories
from herglotz.progress import FitBar
from herglotz.training import fit

LAST = 0.5  # s before the end that are not asked for


class Watched(FitBar):
    """A bar that remembers its drawings: the time and what was left."""

    drawings: ClassVar[list[tuple[float, float]]] = []

    def draw(self) -> None:
        """See `FitBar`."""
        Watched.drawings.append((time.time(), self.left))
        super().draw()


def told(seed: int, index: int) -> tuple[float, list[float], float]:
    """Seconds of the fit, what was said to be left over what was, and the longest time without a drawing."""
    system = draw(seed, index)
    data = trajectories(system, system.train)
    Watched.drawings.clear()
    began = time.time()
    fit(data, progress=True)
    end = time.time()
    ratios = [left / (end - t) for t, left in Watched.drawings if math.isfinite(left) and end - t > LAST]
    times = [began, *(t for t, _ in Watched.drawings), end]
    return end - began, ratios, max(b - a for a, b in pairwise(times))


def main(argv: list[str] | None = None) -> None:
    """See the head of this module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draw", type=int, default=8817, metavar="SEED", help="of the zoo (default: 8817)")
    parser.add_argument("--count", type=int, default=8, metavar="N", help="systems (default: 8)")
    given = parser.parse_args(argv)
    sys.modules["herglotz.training.stages"].FitBar = Watched  # type: ignore[attr-defined]
    every: list[float] = []
    for index in range(given.count):
        seconds, ratios, still = told(given.draw, index)
        every += ratios
        print(f"{index}: {seconds:.1f} s, {said(ratios)}, longest without a drawing {still:.1f} s", flush=True)
    print(f"all: {said(every)}, within a factor of three {within(every, 3):.0%}")


def within(ratios: list[float], factor: float) -> float:
    """Share of the ratios within this factor of 1."""
    return sum(1 / factor <= x <= factor for x in ratios) / max(len(ratios), 1)


def said(ratios: list[float]) -> str:
    """Median and share within a factor of two, in words."""
    return f"left over true {median(ratios or [math.nan]):.2f}, within a factor of two {within(ratios, 2):.0%}"


if __name__ == "__main__":
    main()
