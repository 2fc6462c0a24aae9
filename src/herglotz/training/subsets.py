"""The likeliest subsets of a few terms: all of them are compared by the quadratic model of one fit.

Elimination one by one ends in a subset that no single term leaves; where terms make nearly the same force over the
recorded range, another subset with fewer of them may say as much. 2^K subsets of a linear problem cost next to nothing
while K is small.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.training.arrowhead import dense
from herglotz.training.found_terms import Found, gain
from herglotz.training.named_terms import DRY, NamedTerms, places, shapes_of_dry, values_of
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.pruning import joining

TRIED = 3  # subsets that are proposed: the quadratic model orders them, and fits decide


def price_of(size: int, of: int, worth: float) -> float:
    """What so many terms out of `of` candidates have to lower the cost by: ½ `worth` each, and log of the choices.

    The extended criterion of Chen & Chen (2008): of many subsets some lower the cost much by chance.
    """
    return size * worth / 2 + math.log(math.comb(of, size))


def preferred(other: Found, found: Found, of: int, floor: float) -> bool:
    """Whether the criterion prefers the terms of the other fit out of so many candidates; misfits below `floor` tie."""
    count = other.fit.problem.data.q.numel()
    price, its = (price_of(len(f.terms.names), of, math.log(count)) for f in (found, other))
    return gain(found.rms, other.rms, count, floor) > its - price


def missing(found: Found, problem: ShootingProblem, every: NamedTerms) -> str | None:
    """The term of `every` whose absence from `found` costs most, where that is more than it may; None where none does.

    The problem stands at the fit, its absent terms at 0.
    """
    names = [name for name in every.names if name not in found.terms.names]
    at = places(problem.parameters)
    x = problem.pack(problem.parameters.get(), found.fit.path.x[:, 0, : problem.d])
    cost, A, b = problem.normal_equations(x)
    if not bool(cost.isfinite()):
        return None
    A = dense(A)
    others = torch.tensor([i for name in names for i in at[name]])
    absent = torch.zeros(len(x), dtype=torch.bool)
    absent[others] = True
    if DRY in names:  # what shapes a force of 0 has no effect yet
        absent[shapes_of_dry(problem.parameters)] = True
    best = joining(A, b, (~absent).nonzero()[:, 0], others, math.log(problem.data.q.numel()))
    return None if best is None else next(name for name in names if int(others[best]) in at[name])


class Better(NamedTuple):
    """Terms that may be likelier than those of a fit, and where to start with them."""

    terms: NamedTerms
    values: dict  # by the name of a term or of a parameter
    states: Tensor  # (S, d) at the start of every segment


def likelier(found: Found, problem: ShootingProblem, every: NamedTerms, floor: float) -> list[Better]:
    """Subsets of the terms `every` of `problem` that are likelier than those of `found`, the likeliest first.

    The problem stands at the fit, its absent terms at 0; misfits below `floor` are rounding.
    """
    parameters, held = problem.parameters, torch.tensor([], dtype=torch.long)
    at = places(parameters)
    if DRY in found.terms.names:
        at[DRY] += parameters.index("friction.breakaway").tolist()
    elif DRY in at:  # what shapes a force of 0 has no effect yet
        held = shapes_of_dry(parameters)
    x = problem.pack(parameters.get(), found.fit.path.x[:, 0, : problem.d])
    cost, A, b = problem.normal_equations(x)
    A, b = dense(A).double(), b.double()
    if not (bool(cost.isfinite()) and bool(A.isfinite().all())):
        return []
    A[held], A[:, held], b[held] = 0.0, 0.0, 0.0
    by, names, better = (problem.sigma / max(found.rms, floor)) ** 2, list(at), []
    for subset in subsets(by * A, by * b, x.double(), list(at.values()), math.log(problem.data.q.numel()))[:TRIED]:
        terms = every.only([names[k] for k in subset.kept])
        if terms == found.terms:
            break
        theta, states = problem.unpack(subset.x.to(x))
        better.append(Better(terms, values_of(parameters, theta), states))
    return better


class Subset(NamedTuple):
    """Some of the terms, and the unknowns where they fit best."""

    kept: tuple[int, ...]  # which of the groups stay
    criterion: float  # cost, and the price of the terms that stay
    x: Tensor  # (P,)


def subsets(
    A: Tensor,  # (P, P) JᵀJ of a fit with all terms, residuals over their RMS
    b: Tensor,  # (P,) Jᵀr
    x: Tensor,  # (P,) where both were made
    groups: Sequence[Sequence[int]],  # indices of the coefficients of each term
    worth: float,  # twice the price of a term that is named beforehand; log N by the Bayesian information criterion
) -> list[Subset]:
    """All 2^K subsets of K terms, the likeliest first: those that stay follow the absence of the others.

    With G the Schur complement of A onto the coefficients of all terms and y their best values, the cost is
    ½ (c − y)ᵀ G (c − y) beside a constant, and c is 0 outside of a subset (best subset selection, Hocking & Leslie
    1967; Schwarz 1978 for log N).
    """
    scale = A.diagonal().clamp_min(1e-300).sqrt()
    S = A / scale[:, None] / scale
    at = torch.tensor([i for group in groups for i in group], dtype=torch.long)
    owner = torch.tensor([k for k, group in enumerate(groups) for _ in group], dtype=torch.long)
    rest = torch.ones(len(x), dtype=torch.bool).index_fill(0, at, False).nonzero()[:, 0]
    follow = -torch.linalg.pinv(S[rest][:, rest], hermitian=True) @ S[rest][:, at]
    G = S[at][:, at] + S[at][:, rest] @ follow
    best = x * scale - torch.linalg.pinv(S, hermitian=True) @ (b / scale)
    pull = G @ best[at]
    stays = torch.arange(2 ** len(groups))[:, None] >> torch.arange(len(groups)) & 1
    keep = stays[:, owner].to(A)
    C = torch.linalg.pinv(keep[:, :, None] * G * keep[:, None, :], hermitian=True)
    c = (C @ (keep * pull)[..., None])[..., 0] * keep
    price = torch.tensor([price_of(size, len(groups), worth) for size in range(len(groups) + 1)]).to(A)
    cost = (best[at] @ pull - (c * pull).sum(-1)) / 2 + price[stays.sum(-1)]
    found = []
    for k in cost.argsort().tolist():
        moved = best.clone()
        moved[at] = c[k]
        moved[rest] = best[rest] + follow @ (c[k] - best[at])
        found.append(Subset(tuple(stays[k].nonzero()[:, 0].tolist()), float(cost[k]), moved / scale))
    return found


def best_of_each_size(A: Tensor, x: Tensor, free: Sequence[int]) -> list[Subset]:
    """The likeliest subset of these unknowns for each number of them, the smallest first, by JᵀJ at a minimum x."""
    by_size: dict[int, Subset] = {}
    for subset in subsets(A, torch.zeros_like(x), x, [[i] for i in free], 0.0):
        by_size.setdefault(len(subset.kept), subset)
    return [by_size[size] for size in sorted(by_size)]
