"""Sensors whose zeros differ from recording to recording: y = q + z. The recording of most samples is the reference.

A model cannot follow such recordings together, though each of them alone. Parameters, states and zeros are fitted
together from 0 (`problems.zeros`), and are taken where the fit with them is worth so many numbers more
(`score.fitted_score`). A model that is held says what a new recording reads at 0 (`zeros_of_one`).

Zeros that drift, y = q + d t, are fitted with the whole dictionary in the same way, one rate d a coordinate (`drifts`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.sensors import measured, since_start
from herglotz.models import ContactLagrangian
from herglotz.training.arrowhead import dense
from herglotz.training.first_states import first_states, states_of_pairs
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.zeros import WithZeros, reference_of
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt
from herglotz.training.trajectory_fit import STAGE

ROUNDS = 5  # of fitting a drift
CLEARLY = 5.0  # standard deviations by which a zero differs from 0
THINNED = (1, 2, 4, 8)  # parts of a recording that tell its zeros: all, or every m-th where some cannot be followed


class FoundZeros(NamedTuple):
    """Zeros of the sensors, their standard deviations, and the misfit with them."""

    z: Tensor  # as many as there are unknowns
    deviations: Tensor  # as z
    rms: float


def clear(z: Tensor, deviations: Tensor) -> Tensor:
    """Which zeros are clearly there."""
    return z.abs() > CLEARLY * deviations


def zeros_of_one(model: ContactLagrangian, data: Trajectories, sigma: float, max_step: float) -> tuple[float, ...]:
    """The zeros (n,) of the sensors of one recording, of which these are parts, by a model that is held.

    By multiple shooting, with the states where the parts start; 0 for zeros that are not clearly there. Where the model
    cannot follow some part, every second one is taken, or fewer; zeros are 0 where it follows none of these either.
    """
    found = (
        _of_parts(model, data.select(range(0, len(data), by)), sigma, max_step) for by in THINNED if by <= len(data)
    )
    return next((zeros for zeros in found if zeros is not None), (0.0,) * data.dof)


def _of_parts(model: ContactLagrangian, data: Trajectories, sigma: float, max_step: float) -> tuple[float, ...] | None:
    """By all of these parts; None where the model cannot follow one."""
    problem = ShootingProblem(model, data, segment_grid(data, data.samples, max_step), sigma=sigma, freedom=FREEDOM)
    target = WithZeros(problem, torch.arange(problem.P), shared=True)
    found = _fitted(target, problem.parameters.get(), data)
    return None if found is None else tuple(torch.where(clear(found.z, found.deviations), found.z, 0.0).tolist())


def _fitted(target: WithZeros, theta: Tensor, begin: Trajectories) -> FoundZeros | None:
    """The zeros as a vector, from 0 with these parameters, and states read off `begin`; None where nothing follows."""
    problem = target.problem
    problem.guess_from_states(states_of_pairs(problem.parameters.model, begin))
    return fitted(target, problem.pack(theta, first_states(problem, theta, begin)))


def fitted(target: WithZeros, x: Tensor) -> FoundZeros | None:
    """The zeros as a vector, from 0 where all other unknowns are x; None where nothing follows."""
    problem, x = target.problem, torch.cat([x, x.new_zeros(target.count)])
    result = levenberg_marquardt(target, x, max_iterations=STAGE, rtol=1e-4, patience=3)
    if not math.isfinite(result.cost):
        return None
    _, A, _ = target.normal_equations(result.x)
    A = dense(A)
    assert problem.path is not None
    rms = _rms(problem.misfit(problem.path)[problem.data.complete])
    variance = torch.linalg.pinv(A, hermitian=True).diagonal()[-target.count :] * (rms / problem.sigma) ** 2
    return FoundZeros(result.x[-target.count :], variance.clamp_min(0).sqrt(), rms)


def differing_zeros(problem: ShootingProblem, x: Tensor) -> tuple[Tensor, Tensor] | None:
    """Zeros (B, n) that recordings have beside the reference, and deviations, where the fit of a problem ends at x.

    None where zeros lead nowhere.
    """
    found = fitted(WithZeros(problem), x)
    if found is None:
        return None
    rows = [b for b in range(len(problem.data)) if b != reference_of(problem.data)]
    z, deviations = (x.new_zeros(len(problem.data), problem.n) for _ in range(2))
    z[rows], deviations[rows] = (y.reshape(-1, problem.n) for y in (found.z, found.deviations))
    return z, deviations


def drifts(search: Any) -> tuple[Tensor, Tensor] | None:
    """Rates (n,) at which the zeros of the sensors drift, in units of q per time, and their deviations.

    `search` is a `herglotz.training.search.Search`. None where the model of the whole dictionary, which lacks no term
    that a drift could stand for, is at the noise without it, or not with it.
    """
    if search.config.find_zeros is False:
        return None
    without, t = search.full, since_start(search.data)
    if without is None or not without.whole or without.at_the_noise:
        return None
    trial, rates, deviations = without, t.new_zeros(search.data.dof), t.new_zeros(search.data.dof)
    for _ in range(ROUNDS):  # terms that stood for a drift leave it step by step
        problem = trial.problem.of(trial.problem.parameters.numbers, trial.problem.sigma, trial.prior)
        target = WithZeros(problem, shared=True, grow=t / t.max())
        found = fitted(target, problem.pack(trial.theta, trial.path.x[:, 0, : problem.d]))
        if found is None or not bool(clear(found.z, found.deviations).any()):
            break
        rates, deviations = rates + found.z / t.max(), found.deviations / t.max()
        trial = search.of(measured(search.data, drifts=rates.tolist())).again(trial)
        if trial is None:
            return None
    better = trial is not without and trial.at_the_noise and trial.fits_better(without, len(rates))
    return (rates, deviations) if better else None


def in_words(z: Tensor, deviations: Tensor, reference: int) -> str:
    """Zeros with what they are known to."""
    return f"zeros that differ from those of recording {reference}: {sure(z, deviations)}"


def sure(z: Tensor, deviations: Tensor) -> str:
    """Numbers that were fitted with their deviations."""
    each = zip(z.flatten().tolist(), deviations.flatten().tolist(), strict=True)
    return ", ".join(f"{x:.4g} ± {d:.2g}" for x, d in each if d)


def _rms(x: Tensor) -> float:
    return float(x.square().mean().sqrt())
