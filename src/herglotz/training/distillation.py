"""Networks taught by named terms, where the motion depends on s (Hinton, Vinyals & Dean 2015, distillation).

Positions alone leave s, its rates and the potential to make up for one another: a fit of networks that start at 0 ends
in one of many minima. Named terms, which a search finds, come near the motion and have s and momenta at every sample.
Networks that are fitted to all three, a problem with one minimum near by, then start at these terms, and the fit to
the recording takes up what the terms miss.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from torch import Tensor

from herglotz.data import Trajectories
from herglotz.models import ContactLagrangian
from herglotz.training.config import FitConfig
from herglotz.training.one_step_fit import fit_one_step
from herglotz.training.problems.one_step import SupervisedProblem
from herglotz.training.problems.prior import prior_of
from herglotz.training.stages import Stages
from herglotz.training.structure import kept_structure, search, terms_are_free
from herglotz.training.task import NOISY, Task, build_model
from herglotz.training.trajectory_fit import fit_states

# Iterations: errors are then below `NOISY`.
ITERATIONS = 40


class Taught(NamedTuple):
    """A model that named terms have taught, and s at every sample as these have it."""

    model: ContactLagrangian
    s: Tensor  # (N,)


def taught(task: Task, network: str, *, outliers: bool) -> Taught | None:
    """A model with this `network` (`build_model`) whose motion depends on s, fitted to the motion of named terms.

    None for a model whose motion does not depend on s, and where the user names terms or supervises s, or a search
    finds no terms that follow whole trajectories.
    """
    task = replace(task, base=replace(task.base, start={}))
    model, c = task.build(network), task.config
    # A search has one optimiser, and steps of its own.
    if not model.s_enters_motion or c.optimiser != "lm" or c.substeps != 1:
        return None
    # The recording stays as it is read: what terms miss may look like zeros of the sensors.
    free = replace(c, level="auto", objective="auto", sticking=None, find_zeros=False)
    if not terms_are_free(task.data, free):
        return None
    lesson = _lesson(task, free, outliers)
    if lesson is None or lesson.s is None:
        return None
    problem = SupervisedProblem(
        model, lesson, momenta=True, max_step=task.base.max_step, sigma=NOISY * task.size,
        prior=prior_of(model, task.base, None),
    )  # fmt: skip
    fit_one_step(replace(task, data=lesson), problem, "one-step errors of named terms", ITERATIONS)
    return Taught(model, lesson.s)


def _lesson(task: Task, config: FitConfig, outliers: bool) -> Trajectories | None:
    """The samples with positions, momenta and s of named terms that follow them."""
    find = lambda: search(task.data, task.base, config, outliers=outliers)  # noqa: E731
    found = kept_structure("named terms", find, task.base, config, task.stages)
    if found.sigma is None or found.reading:
        return None
    teacher = build_model(found.base, found.config, "none")
    fit = fit_states(replace(task, stages=Stages()), teacher, max(found.sigma, task.exact))
    if fit is None:
        return None
    n, states = task.data.dof, fit.states()
    return replace(task.data, q=states[:, :n], p=states[:, n : 2 * n], s=states[:, -1])
