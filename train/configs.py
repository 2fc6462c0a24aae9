"""Experiments by name: each function says which data and which settings. Add one by writing one function."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from herglotz.data import Trajectories, load, simulate
from herglotz.scenes import scene
from herglotz.training import FitConfig

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Experiment:
    """Data and settings of one fit."""

    data: Callable[[], Trajectories]
    fit: FitConfig
    about: str


def demo() -> Experiment:
    return Experiment(
        lambda: load(ROOT / "data" / "demo_pendulum.csv"),
        FitConfig(),
        "bundled damped pendulum: positions only, noise 0.003 rad, two gaps a trajectory",
    )


def pendulum() -> Experiment:
    return Experiment(
        lambda: simulate(scene("damped_pendulum"), trajectories=40, steps=40, h=0.5, seed=0),
        FitConfig(train_fraction=1.0, objective="residual"),
        "exact damped pendulum, 40 trajectories of 41 positions at h = 0.5: about thirteen steps a period",
    )


def collapse() -> Experiment:
    return Experiment(
        lambda: simulate(scene("damped_pendulum"), trajectories=40, steps=40, h=0.5, seed=0),
        FitConfig(train_fraction=1.0, objective="raw", optimiser="adam", iterations=100),
        "the same data, a plain network trained by Adam on the raw |R|²: it collapses, and verify says so",
    )


def real_pendulum() -> Experiment:
    return Experiment(
        lambda: load(ROOT.parent / "shared" / "data" / "schmidt_lipson_2009" / "real_pend_h_1.txt"),
        FitConfig(),
        "a pendulum somebody measured (Schmidt & Lipson 2009); see data/README.md for where to get the file",
    )


CONFIGS: dict[str, Callable[[], Experiment]] = {f.__name__: f for f in (demo, pendulum, collapse, real_pendulum)}
