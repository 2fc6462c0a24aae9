"""Combinations of physical parameters that the data do not determine, because one parameter can replace another.

With A = JᵀJ of the fit, prior included, the information of the data on the parameters φ of interest, marginal over all
other unknowns r, is the Schur complement M = A_φφ − A_φr A_rr⁻¹ A_rφ minus the prior of φ. Eigenvectors with small
eigenvalues are the combinations (`herglotz.training.trades`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.errors import refuse
from herglotz.training.equation_numbers import Joint
from herglotz.training.trades import Trade, combinations
from herglotz.training.uncertainty import Laplace

PHYSICAL = ("kinetic.log", "kinetic.off", "potential.stiffness", "potential.tilt", "damping.rate", "damping.drag",
            "friction.")  # fmt: skip


def traded(posterior: Laplace) -> list[Trade]:
    """The combinations of physical parameters that the data of a fit do not determine, the worst first; [] if none."""
    names = posterior.problem.parameters.numbers
    rows = torch.tensor([i for i, name in enumerate(names) if name.startswith(PHYSICAL)], dtype=torch.long)
    M = information_of(posterior, rows)
    return combinations(M, posterior.information.diagonal()[rows], [names[i] for i in rows.tolist()])


def information_of(posterior: Laplace, rows: Tensor) -> Tensor:
    """The information M (K, K) of the data on the parameters at the places `rows` (K,); see the head of this module."""
    A = posterior.information
    rest = torch.ones(len(A), dtype=torch.bool)
    rest[rows] = False
    rest = rest.nonzero()[:, 0]
    _, prior, _ = posterior.prior.normal_equations(posterior.theta)
    inverse = torch.linalg.pinv(A[rest[:, None], rest], hermitian=True)
    M = A[rows[:, None], rows] - A[rows[:, None], rest] @ inverse @ A[rest[:, None], rows]
    return M - prior.double()[rows[:, None], rows]


def joint_of(posterior: Laplace, least: float) -> Joint:
    """The joint posterior of all numbers, on the CPU, if positions are precise only to `least`, in units of q.

    Raise InputError if a change of some number by its rounding error in float64 moves the motion by more than the
    misfit: the motion is too unstable for the first-order posterior.
    """
    P, sigma = len(posterior.theta), posterior.sigma
    rounding = max(1.0, least / (sigma * posterior.inflation)) ** 2
    alone = posterior.information.diagonal()[:P].clamp_min(1e-300).rsqrt() * max(1.0, least / sigma)
    lost = alone < torch.finfo(torch.float64).eps * posterior.theta.abs().to(alone)
    refuse({"rounding errors of the model's numbers change its motion by more than the misfit": bool(lost.any())})
    every = posterior.covariance[:P, :P] * rounding, alone, information_of(posterior, torch.arange(P))
    return Joint(*(x.cpu() for x in every))
