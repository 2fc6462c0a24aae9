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
from herglotz.training.first_states import first_states
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.least_squares import StatesOnly
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.smoothing import DAMPING, SmoothingProblem
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt

# Process noise per radian of motion over the measurement noise (`smooth`): small, so that states follow the model.
PROCESS_NOISE = 0.1


@dataclass(frozen=True)
class Smoothed:
    """States at every sample and their standard errors for a fixed model; s has 0 if the motion has no s."""

    states: State  # (N, n), (N, n), (N,)
    std: State  # (N, n), (N, n), (N,)


def smooth(model: ContactLagrangian, data: Trajectories, sigma: float, *, process: float = 0.1) -> Smoothed:
    """The smoothed states of each trajectory for a fixed model.

    Parameters
    ----------
    model
        The dynamics; its parameters stay fixed.
    data
        Positions, and inputs if the model takes inputs. Steps may differ, samples may be missing.
    sigma
        Standard deviation of the noise of q, in its units.
    process
        Process noise (`SmoothingProblem`). Small: the states follow the model; large: they follow the data.

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
        raise InputError(
            f"{where}: a step of the model near these data fails, so nothing can be smoothed; fit it again"
        )
    x, _ = solved
    found = problem.states(x)
    std = torch.zeros_like(found)
    std[:, : problem.d] = problem.variances(x).clamp_min(0).sqrt()
    return Smoothed(*(state_of(y) for y in (found, std)))


def process_noise(model: ContactLagrangian, h: float) -> float:
    """`process` of `SmoothingProblem` for steps h; it grows as √h, since the variance of a random force adds up."""
    angle = h * max(v / x for v, x in zip(model.config.speed, model.config.scale, strict=True))
    return PROCESS_NOISE * min(1.0, angle) ** 0.5


def smoothed_states(problem: SmoothingProblem) -> tuple[Tensor, float] | None:
    """All unknowns with smoothed states and a fixed model, and ½|r|²; None if a step near the data fails."""
    x = smoothing_start(problem)
    states = StatesOnly(problem, x[: problem.P])
    result = levenberg_marquardt(states, x[problem.P :], rtol=1e-10, patience=1, damping=DAMPING)
    return None if result.reason == "not_finite" else (states.full(result.x), result.cost)


def smoothing_start(problem: SmoothingProblem) -> Tensor:
    """The start of smoothing: straight lines between samples, or with dry friction a motion of the model near the data.

    A sticking joint stands still whatever its momentum: there the positions of a start with defects have no slope by
    the momenta, and the defects stay. A motion of the model has no defects.
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
