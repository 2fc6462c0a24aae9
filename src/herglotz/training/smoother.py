"""Smoothed states of a fixed model, with their standard errors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.checks import check_positive
from herglotz.data.smoothing import smoothed
from herglotz.data.trajectories import GAP
from herglotz.errors import InputError
from herglotz.models import ContactLagrangian
from herglotz.stepping import State, state_of
from herglotz.stepping.block_tridiagonal import diagonal_of_inverse
from herglotz.training.first_states import first_states
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.least_squares import StatesOnly
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.smoothing import DAMPING, SmoothingProblem
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt


@dataclass(frozen=True)
class Smoothed:
    """States at every sample and their standard errors, given the model."""

    states: State  # (N, n), (N, n), (N,)
    std: State  # the same shapes; s has 0 where the motion does not depend on it


def smooth(model: ContactLagrangian, data: Trajectories, sigma: float, *, process: float = 0.1) -> Smoothed:
    """Return the smoothed states of each trajectory for a fixed model.

    Parameters
    ----------
    model
        The dynamics; its parameters are held.
    data
        Positions, and inputs where the model takes them; steps may differ, samples may be missing.
    sigma
        Standard deviation of the noise of q, in its units.
    process
        Of `SmoothingProblem`. Small: the model is believed; large: the data are.

    Raises
    ------
    InputError
        If sigma or process is not positive, or a step has no solution near the data.
    """
    check_positive("sigma", sigma)
    check_positive("process", process)
    data = data.unwrapped()
    problem = SmoothingProblem(
        model, data, segment_grid(data, data.samples, GAP * data.typical_step), sigma=sigma, process=process
    )
    solved = smoothed_states(problem)
    if solved is None:
        where = data.source or "data"
        raise InputError(f"{where}: the model has no step near these data, so nothing can be smoothed; fit it again")
    x, _ = solved
    found = problem.states(x)
    std = torch.zeros_like(found)
    _, matrix, _ = problem.normal_equations(x, held=True)
    std[:, : problem.d] = problem.grid.at_samples(diagonal_of_inverse(matrix.blocks).clamp_min(0).sqrt())
    return Smoothed(*(state_of(y) for y in (found, std)))


def smoothed_states(problem: SmoothingProblem) -> tuple[Tensor, float] | None:
    """All unknowns with the states smoothed, the model held, and ½|r|²; None where it has no step near the data."""
    x = smoothing_start(problem)
    states = StatesOnly(problem, x[: problem.P])
    result = levenberg_marquardt(states, x[problem.P :], rtol=1e-10, patience=1, damping=DAMPING)
    return None if result.reason == "not_finite" else (states.full(result.x), result.cost)


def smoothing_start(problem: SmoothingProblem) -> Tensor:
    """Unknowns that smoothing starts from: straight lines between samples, or the model's own motion near them.

    A joint that set-valued friction holds stands still whatever its momentum is, so that a search which starts with
    defects cannot mend them there; the motion from a start state has none.
    """
    x, data, model = problem.start(), problem.data, problem.parameters.model
    if model.friction is None or not model.friction.dry:
        return x
    shooting = ShootingProblem(model, data, problem.grid, sigma=problem.sigma)
    theta = shooting.parameters.get()
    states = first_states(shooting, theta, smoothed(data))
    found = levenberg_marquardt(StatesOnly(shooting, theta), states.flatten())
    path = shooting.solve(shooting.pack(theta, found.x))
    return x if path is None else torch.cat([theta, path.x[..., : problem.d].flatten()])
