"""Jobs of the zoo and of the open zoo: default flags, errors over the noise."""

from __future__ import annotations

from pathlib import Path

from benchmarks.judging.job import Job
from benchmarks.zoo_systems.drawing import draw
from benchmarks.zoo_systems.open_laws import fixed_law
from benchmarks.zoo_systems.open_systems import open_draw
from benchmarks.zoo_systems.ours import job_of


def known(folder: Path, seed: int, index: int) -> Job:
    return job_of(folder, draw(seed, index))


def drawn_open(folder: Path, seed: int, index: int) -> Job:
    return job_of(folder, open_draw(seed, index))


def law(folder: Path, number: int, noise: float) -> Job:
    return job_of(folder, fixed_law(number, noise))
