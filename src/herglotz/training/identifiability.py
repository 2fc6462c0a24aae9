"""Combinations of physical parameters that the data do not determine, because one can replace another.

With A = JᵀJ of the fit, prior included, the information that the data hold on the parameters φ of interest, whatever
the networks and the states are, is the Schur complement M = A_φφ − A_φr A_rr⁻¹ A_rφ less the prior of φ. Its small
eigenvalues are what one of them can make up for in another (`herglotz.training.trades`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from herglotz.training.equation_numbers import Joint
from herglotz.training.trades import Trade, combinations
from herglotz.training.uncertainty import Laplace

PHYSICAL = ("kinetic.log", "kinetic.off", "potential.stiffness", "potential.tilt", "damping.rate", "damping.drag",
            "friction.")  # fmt: skip


def traded(posterior: Laplace) -> list[Trade]:
    """The combinations of physical parameters that these data do not determine, the worst first; [] if there is none.

    `posterior` is that of a fit (`herglotz.training.laplace`).
    """
    names = posterior.problem.parameters.numbers
    rows = torch.tensor([i for i, name in enumerate(names) if name.startswith(PHYSICAL)], dtype=torch.long)
    M = information_of(posterior, rows)
    return combinations(M, posterior.information.diagonal()[rows], [names[i] for i in rows.tolist()])


def information_of(posterior: Laplace, rows: Tensor) -> Tensor:
    """What the data alone say of these parameters, whatever the others and the starts are; see the head of this module.

    `rows` are their places, (K,); returns (K, K).
    """
    A = posterior.information
    rest = torch.ones(len(A), dtype=torch.bool)
    rest[rows] = False
    rest = rest.nonzero()[:, 0]
    _, prior, _ = posterior.prior.normal_equations(posterior.theta)
    inverse = torch.linalg.pinv(A[rest[:, None], rest], hermitian=True)
    M = A[rows[:, None], rows] - A[rows[:, None], rest] @ inverse @ A[rest[:, None], rows]
    return M - prior.double()[rows[:, None], rows]


def joint_of(posterior: Laplace, least: float) -> Joint:
    """What the data say of all numbers together, if they are known no better than to `least`, in units of q.

    On the CPU, wherever the fit was: these are a few numbers that words are made of.
    """
    P, sigma = len(posterior.theta), posterior.sigma
    rounding = max(1.0, least / (sigma * posterior.inflation)) ** 2
    alone = posterior.information.diagonal()[:P].clamp_min(1e-300).rsqrt() * max(1.0, least / sigma)
    every = posterior.covariance[:P, :P] * rounding, alone, information_of(posterior, torch.arange(P))
    return Joint(*(x.cpu() for x in every))
