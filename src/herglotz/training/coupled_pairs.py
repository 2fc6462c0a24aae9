"""Pairs of coordinates between which a force acts, so that a search of many coordinates need not offer every pair.

The acceleration of each coordinate is a linear regression on all positions, the own velocity and all inputs,

    q̈ᵢ = Σⱼ aᵢⱼ qⱼ + bᵢ + cᵢ q̇ᵢ + Σₖ dᵢₖ uₖ,

over smoothed samples. A position stays if the fit needs it by the extended Bayesian information criterion (Chen & Chen
2008), which also asks for the price of a choice among n − 1 positions. Nonlinear terms are offered where the linear one
stays (marginality, Nelder 1977). A force that is even in q_i − q_j, in motion that goes as far to either side of rest,
has no linear part, and a damper without a spring has none of the position: such pairs are not found.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from itertools import combinations

import torch

from herglotz.data import Trajectories
from herglotz.data.smoothing import local_polynomials
from herglotz.least_squares import least_squares
from herglotz.models.features import lengths, parse
from herglotz.training.pruning import prune


def coupled_pairs(data: Trajectories) -> list[tuple[int, int]] | None:
    """Pairs i < j of coordinates, counted from 0, of which either acceleration needs the other position.

    None if there are too few independent samples for the n + m + 2 coefficients of a coordinate with m inputs. Samples
    that share half a smoothing window are dependent: their number is divided by the overlap.
    """
    data = data.to(torch.float64, "cpu")
    local = local_polynomials(data)
    if local is None:
        return None
    n, overlap = data.dof, local.width / 2
    half = local.half[local.centred, None]
    q, v, a = (local.coefficients[local.centred, k] * math.factorial(k) / half**k for k in range(3))
    u = data.q.new_zeros(data.samples, 0) if data.u is None else data.u
    count, coefficients = len(q) / overlap, n + 2 + u.shape[1]
    if count <= coefficients:
        return None
    worth, kept = math.log(count) + 2 * math.log(n - 1), torch.zeros(n, n, dtype=torch.bool)
    for i in range(n):
        X = torch.cat([q, torch.ones_like(half), v[:, i, None], u[local.centred]], 1)
        x = least_squares(X, a[:, i, None])[:, 0]
        variance = float((a[:, i] - X @ x).square().mean()) / (1 - coefficients / count)
        others = torch.tensor([j for j in range(n) if j != i])
        kept[i, prune(X.T @ X, x, others, worth * overlap * variance)[0]] = True
    return [(i, j) for i, j in combinations(range(n), 2) if bool(kept[i, j] | kept[j, i])]


def terms_between(coupled: Collection[tuple[int, int]], data: Trajectories) -> tuple[str, ...]:
    """The features of the dictionary `lengths` that are of one coordinate, or of two in these pairs (`difference`)."""
    own, between = {}, {f"(q{i + 1} - q{j + 1})": difference("q", i, j, data) for i, j in coupled}
    for name in lengths(data.angles):
        form, mark, power = name.partition("^")
        if len(_coordinates(name, data.angles)) == 1:
            own[name] = name
        elif form in between:
            own[name] = between[form] + mark + power
    return tuple(own.values())


def difference(x: str, i: int, j: int, data: Trajectories) -> str:
    """The text of the difference of two coordinates or speeds; coordinates of different units count by their size.

    A spring between a metre and a degree would be that of the metre alone, and what it does to the angle a small
    difference of large terms.
    """
    ratio = "" if data.units[i] == data.units[j] else f"{float(data.balance[j] / data.balance[i]):.3g} "
    return f"({ratio}{x}{i + 1} - {x}{j + 1})"


def groups(features: Collection[str], angles: Sequence[bool]) -> list[list[int]]:
    """Coordinates, counted from 0, that features of several coordinates join to one another, each group in order."""
    group = {i: [i] for i in range(len(angles))}
    for name in features:
        first, *others = _coordinates(name, angles)
        for other in others:
            if group[other] is not group[first]:
                joined = sorted(group[first] + group[other])
                group |= dict.fromkeys(joined, joined)
    return [own for i, own in group.items() if own[0] == i]


def _coordinates(feature: str, angles: Sequence[bool]) -> tuple[int, ...]:
    """The coordinates, counted from 0, that a feature depends on."""
    return tuple(i for i, w in enumerate(parse(feature, angles)[0].form) if w)
