"""Jobs of the zoo and of the open zoo: default flags, errors over the noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.judging.job import Job, Trial
from benchmarks.zoo_systems.drawing import draw
from benchmarks.zoo_systems.open_laws import fixed_law
from benchmarks.zoo_systems.open_systems import open_draw
from benchmarks.zoo_systems.ours import trajectories, unit
from benchmarks.zoo_systems.systems import ZooSystem
from herglotz.data import save


def known(folder: Path, seed: int, index: int) -> Job:
    return _written(folder, draw(seed, index))


def drawn_open(folder: Path, seed: int, index: int) -> Job:
    return _written(folder, open_draw(seed, index))


def law(folder: Path, number: int, noise: float) -> Job:
    return _written(folder, fixed_law(number, noise))


def _written(folder: Path, of: ZooSystem) -> Job:
    save(folder / "train.csv", trajectories(of, of.train))
    save(folder / "unseen.csv", trajectories(of, of.test))
    scale, size = ((x * unit(of)).tolist() for x in (of.floor, of.size))
    trials = [Trial("unseen.csv", of.warmup)]
    best = max(1.0, float(np.round(of.attainable or 1.0, 3)))
    return Job("train.csv", trials, scale=scale, unit="over noise", size=size, attainable=best, facts=of.facts())
