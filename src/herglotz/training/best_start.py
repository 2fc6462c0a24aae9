"""The part of a prediction's error that no other start makes smaller: free runs from the best start."""

from __future__ import annotations

from dataclasses import replace

import torch

from herglotz.data import Trajectories
from herglotz.training.baseline import estimate_baseline
from herglotz.training.fitted_run import FittedRun
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.trajectory_fit import fit_states
from herglotz.training.verdict import STATE_ITERATIONS


def missed_from_best_start(run: FittedRun, data: Trajectories) -> tuple[float, ...] | None:
    """RMS misfit of each coordinate, in its units, by free runs whose start states are fitted to whole recordings.

    A warm-up tells a velocity to about σ √12 / (T √K), K samples over a time T, and a free run carries the error on.
    From no other start does the model miss less. `data` are those of a `Prediction`. None if the model
    follows only parts of the recordings.
    """
    base = estimate_baseline(data, substeps=run.decided.substeps)
    task = Task(data, base, replace(run.decided, iterations=STATE_ITERATIONS), Stages())
    found = fit_states(task, run.model, run.metrics.get("sigma") or task.exact)
    if found is None or found.problem.grid.segments > len(data):
        return None
    with torch.no_grad():
        missed = (found.problem.misfit(found.path) * data.balance)[data.complete]
    return tuple(missed.square().mean(0).sqrt().tolist())
