"""Zeros of sensors that differ between recordings, y = q + z, or drift, y = q + d t.

A model can follow each of several recordings alone, but not all together, if the zeros z of their sensors differ. They
are fitted with the parameters and states, starting from 0 (`problems.zeros`), and are kept if the fit is better for its
number of parameters (`score.fitted_score`). Where the model does not tell them apart from a force, they are those
beside the recording with the most samples, the reference. With frozen parameters, `zeros_of_one` fits the zeros of a
new recording.

Drifts are fitted in the same way with the whole dictionary, one rate d for each coordinate (`drifts`).
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.sensors import measured, since_start
from herglotz.models import ContactLagrangian
from herglotz.training.cross_validation import FOLDS
from herglotz.training.first_states import first_states, states_of_pairs
from herglotz.training.problems.grid import segment_grid
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.zeros import WithZeros
from herglotz.training.solvers.levenberg_marquardt import levenberg_marquardt
from herglotz.training.trajectory_fit import STAGE

# Fits of a drift, one after the other.
DRIFT_FITS = 5
# The start of the note on zeros that agree: a model has no reason to take them for those of sensors.
CENTRE = "alike in all recordings, so that the terms of the model are about them: "
# Least size of a significant zero, in standard deviations.
SIGNIFICANT = 5.0
# Strides in the parts of a recording whose zeros are fitted: all parts, or every m-th if some cannot be followed.
STRIDES = (1, 2, 4, 8)


def reference_of(data: Trajectories) -> int:
    """The recording of most samples, the first of several."""
    return max(range(len(data)), key=lambda b: data.lengths[b])


def clear(z: Tensor, deviations: Tensor) -> Tensor:
    """True for zeros that differ significantly from 0, of the shape of z."""
    return z.abs() > SIGNIFICANT * deviations


def zeros_of_one(model: ContactLagrangian, data: Trajectories, sigma: float, max_step: float) -> tuple[float, ...]:
    """The zeros (n,) of the sensors of one recording, whose parts are `data`, with the parameters of the model frozen.

    Multiple shooting over the zeros and the start states of the parts. A zero that is not significant is 0. If the
    model cannot follow some part, every second part is fitted, or fewer (`STRIDES`); if none can be followed, all
    zeros are 0.

    Within a part a zero and an error of the model's forces look alike. The standard deviation of a zero is therefore at
    least what its values in groups of successive parts say.
    """

    def of(parts: Trajectories) -> tuple[Tensor, Tensor] | None:
        return _of_parts(model, parts, sigma, max_step)

    for stride in (stride for stride in STRIDES if stride <= len(data)):
        parts = data.select(range(0, len(data), stride))
        if (found := of(parts)) is None:
            continue
        z, deviations = found
        edges = torch.linspace(0, len(parts), FOLDS + 1).long().tolist() if len(parts) >= FOLDS else []
        groups = [own[0] for edge in pairwise(edges) if (own := of(parts.select(range(*edge)))) is not None]
        if len(groups) > 1:
            deviations = deviations.maximum(torch.stack(groups).std(0) / len(groups) ** 0.5)
        return tuple(torch.where(clear(z, deviations), z, 0.0).tolist())
    return (0.0,) * data.dof


def _of_parts(
    model: ContactLagrangian, data: Trajectories, sigma: float, max_step: float
) -> tuple[Tensor, Tensor] | None:
    """The zeros (n,) of all of these parts, and their deviations; None if the model cannot follow some part."""
    problem = ShootingProblem(model, data, segment_grid(data, data.samples, max_step), sigma=sigma, freedom=FREEDOM)
    problem.guess_from_states(states_of_pairs(model, data))
    theta = problem.parameters.get()
    x = problem.pack(theta, first_states(problem, theta, data))
    found = fitted(WithZeros(problem, shared=True, held=True), x)
    return None if found is None else (found[0], deviations_of(found[1]))


def fitted(target: WithZeros, x: Tensor, start: Tensor | None = None) -> tuple[Tensor, Tensor] | None:
    """The zeros (C,), fitted from `start`, or else 0, with all other unknowns at x, and their covariance (C, C).

    None if the fit fails.
    """
    problem = target.problem
    result = levenberg_marquardt(target, target.start(x, start), max_iterations=STAGE, rtol=1e-4, patience=3)
    if not math.isfinite(result.cost):
        return None
    covariance = target.normal_equations(result.x)[1].covariance()
    if covariance is None or problem.path is None:
        return None
    rms = float(problem.misfit(problem.path)[problem.data.complete].square().mean().sqrt())
    own = slice(problem.P, problem.P + target.count)
    return target.zeros_of(result.x), covariance[own, own] * (rms / problem.sigma) ** 2


def deviations_of(covariance: Tensor) -> Tensor:
    """Standard deviations, the roots of the diagonal."""
    return covariance.diagonal().clamp_min(0).sqrt()


def means(data: Trajectories) -> Tensor:
    """The mean positions (B, n) of each recording, about which a body on a spring moves; of angles without turns."""
    each = zip(data.q.split(data.lengths), data.complete.split(data.lengths), strict=True)
    return without_turns(torch.stack([q[there].mean(0).nan_to_num() for q, there in each]), data)


def without_turns(z: Tensor, data: Trajectories) -> Tensor:
    """Zeros (..., n) of which those of angles are between −π and π."""
    turns = (z / (2 * math.pi)).round() * z.new_tensor([float(angle) for angle in data.angles])
    return z - 2 * math.pi * turns


def differing_zeros(
    problem: ShootingProblem, x: Tensor, start: Tensor | None = None, taken: Tensor | None = None
) -> tuple[Tensor, Tensor] | None:
    """Zeros (B, n) of B recordings and their standard deviations; None if the fit fails.

    x are the unknowns of the fitted problem without zeros, from which the fit begins with zeros `start`, or else 0. The
    zeros `taken` off the readings before are added. Where the model does not tell the zero of the reference, zeros are
    those beside the reference, whose own is 0: a model with a constant force has any.
    """
    found = fitted(WithZeros(problem), x, start)
    if found is None:
        return None
    B, n, reference = len(problem.data), problem.n, reference_of(problem.data)
    z, covariance = found[0].reshape(B, n), found[1].reshape(B, n, B, n)
    z, deviations = z if taken is None else z + taken, deviations_of(found[1]).reshape(B, n)
    told = clear(z[reference], deviations[reference])
    beside = covariance - covariance[reference]
    beside = deviations_of((beside - beside[:, :, reference, None]).reshape(B * n, B * n)).reshape(B, n)
    z = without_turns(torch.where(told, z, z - z[reference]), problem.data)
    return z, torch.where(told, deviations, beside)


def differ_between(z: Tensor, deviations: Tensor) -> bool:
    """True if zeros (B, n) differ between recordings."""
    return bool(clear(z - z[:1], deviations).any())


def drifts(search: Any, *, met: bool = False) -> tuple[Tensor, Tensor] | None:
    """Drift rates (n,) of the zeros of the sensors, in units of q per time, and their standard deviations.

    `search` is a `herglotz.training.search.Search`. The model of the whole dictionary decides, because it lacks no
    term for which a drift could make up. Where its terms make up for a drift, as those of an undriven motion do, whose
    middle moves as it decays, the simplest model decides. None if the model is at the noise without drifts, or not at
    the noise with drifts. With `met`, a model without drifts is at the noise, and the simplest one alone is asked.
    """
    if search.config.find_zeros is False:
        return None
    for name in ("simplest",) if met else ("full", "simplest"):
        without = getattr(search, name)
        misses = without is not None and without.whole and not without.at_the_noise
        if misses and (found := _drifts_beside(search, without)) is not None:
            return found
    return None


def _drifts_beside(search: Any, without: Any) -> tuple[Tensor, Tensor] | None:
    """The drifts with which the model `without` drifts is at the noise, and better by their price; else None."""
    t = since_start(search.data)
    trial, rates, deviations = without, t.new_zeros(search.data.dof), t.new_zeros(search.data.dof)
    # Each fit moves only a part of a drift out of the terms that made up for it.
    for _ in range(DRIFT_FITS):
        problem = trial.problem.of(trial.problem.parameters.numbers, trial.problem.sigma, trial.prior)
        target = WithZeros(problem, shared=True, grow=t / t.max())
        found = fitted(target, problem.unknowns(trial.theta, trial.path))
        if found is None or not bool(clear(found[0], deviations_of(found[1])).any()):
            break
        rates, deviations = rates + found[0] / t.max(), deviations_of(found[1]) / t.max()
        trial = search.of(measured(search.data, drifts=rates.tolist())).again(trial)
        if trial is None:
            return None
    better = trial is not without and trial.at_the_noise and trial.fits_better(without, len(rates))
    return (rates, deviations) if better else None


def in_words(z: Tensor, deviations: Tensor, reference: int) -> str:
    """The zeros and their standard deviations, as a note for the report."""
    own = deviations[reference] > 0
    if bool(own.all()):
        differ = bool(clear(z - z.mean(0), deviations).any())
        return f"{'zeros: ' if differ else CENTRE}{sure(z, deviations)}"
    some = ", of some coordinates," if bool(own.any()) else ""
    return f"zeros that differ{some} from those of recording {reference}: {sure(z, deviations)}"


def sure(z: Tensor, deviations: Tensor) -> str:
    """Fitted values as text, x ± deviation; values with a deviation of 0 were not fitted and are left out."""
    each = zip(z.flatten().tolist(), deviations.flatten().tolist(), strict=True)
    return ", ".join(f"{x:.4g} ± {d:.2g}" for x, d in each if d)
