"""Figures of the sources, measured with our implementations at the sources' own settings."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tqdm import tqdm

from . import discrete, hamiltonian, lagrangian
from .figures import Figure

# A task is a run of one seed that measures some figures; `MOST` limits the seeds of those that take long.
TASKS: dict[str, Callable[..., dict[str, float]]] = {
    "mass–spring": hamiltonian.mass_spring,
    "damped spring": hamiltonian.damped_spring,
    "Kepler": discrete.kepler,
    "damped double pendulum": discrete.damped_double_pendulum,
    "Kepler, momenta as velocities": lagrangian.kepler_momenta,
    "double pendulum": lagrangian.double_pendulum,
    "arm": lagrangian.arm,
}
MOST = {"Kepler": 3, "Kepler, momenta as velocities": 3, "double pendulum": 3, "arm": 3}
FIGURES: dict[str, dict[str, Figure]] = {**hamiltonian.FIGURES, **discrete.FIGURES, **lagrangian.FIGURES}
NOTE = (
    "What is run, and where it departs from the source: `benchmarks/peers/reproduce/`. Agreement, fixed "
    "before the runs at these settings: the range of our seeds meets the spread of the source; where the source "
    "gives one number, our median lies within half a decade of what was read off a logarithmic plot, or is at most "
    "twice a printed error. Three seeds where one takes more than three minutes. torchdiffeq, pysindy and phlearn "
    "are the published packages; the step map has no source of its own, the plain nets of the first two sources are "
    "its like. Hansen et al. 2025 (forced discrete Lagrangian nets) print no number that could be had: Menda et al. "
    "fit the same equation with a structured Lagrangian. The double pendulum of the LNN has a quarter of the source's "
    "steps with an eighth of its points and a fortieth of its weights. It had 45 000 steps before: at seed 0 mean "
    "7.0e-03, median 4.0e-03, accelerations 4.1e-01, at seed 1 a mean of 157, for one start of 40 diverged; the median "
    "and the accelerations were added then. DeLaN's motions are our own, for the source's characters are in a pickled "
    "file; on those, read apart, seed 0 gives 4.4e-05. Its factor and its batches were made the source's after seed 0 "
    "without had given 5.6e-06. The LNN on Kepler is as Lishkova et al. measured it, beside their own method."
)


def reproduce(result: dict[str, Any], seeds: int, save: Callable[[], None], effort: float = 1.0) -> None:
    """Fill `reproduced` of the result, seed by seed, and save after each task of a seed.

    Parameters
    ----------
    result
        What is in peers.json; seeds that it holds are not measured again.
    seeds
        How many, from 0 on.
    save
        Called whenever something was added.
    effort
        Part of the training, 1 but for tests.
    """
    table = result.setdefault("reproduced", {})
    result["reproduced_note"] = NOTE
    todo = []
    for seed in range(seeds):
        for task, figures in FIGURES.items():
            done = min(len(table.get(f"{task}, {name}", {}).get("here", ())) for name in figures)
            if done <= seed < MOST.get(task, seeds):
                todo.append((seed, task))
    with tqdm(todo, disable=None) as bar:
        for seed, task in bar:
            bar.set_postfix_str(f"{task}, seed {seed}")
            with torch.random.fork_rng():
                torch.manual_seed(seed)  # of the layers' weights
                found = TASKS[task](seed, effort)
            for name, value in found.items():
                figure = FIGURES[task][name]
                one = table.setdefault(f"{task}, {name}", {"here": []})
                here = [*one["here"], value]
                one |= {"figure": f"{task}, {name}", "source": figure.source, "rule": figure.rule, "here": here}
                one["agrees"] = figure.agrees(here)
            save()
