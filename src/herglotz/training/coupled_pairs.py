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
from typing import NamedTuple

import torch
from torch import Tensor

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
    rows = _regressions(data)
    if rows is None:
        return None
    n, kept = data.dof, torch.zeros(data.dof, data.dof, dtype=torch.bool)
    for i, row in enumerate(rows):
        kept[i, row.kept] = True
    return [(i, j) for i, j in combinations(range(n), 2) if bool(kept[i, j] | kept[j, i])]


def proportions(data: Trajectories) -> dict[tuple[int, int], str]:
    """The ratio ρ of coordinates i < j, counted from 1, between which a force of ρ q_i − q_j acts.

    Asked of coordinates of different units, whose difference says nothing before one of them is multiplied by a ratio:
    of a belt, the radius of its pulley; and of shafts that turn once at least: no spring holds them to the frame, and a
    gear may join them. −a_i / a_j of the regression that leaves the smaller share of its acceleration
    is ρ. None of angles, whose waves repeat, and of shafts that turn together.
    """
    pairs, shafts = list(combinations(range(data.dof), 2)), _shafts(data)
    asked = [(i, j) for i, j in pairs if data.units[i] != data.units[j] or (shafts[i] and shafts[j])]
    if not asked or any(data.angles) or (rows := _regressions(data, dampers=True)) is None:
        return {}
    found = {}
    for i, j in asked:
        own = [row for k, other in ((i, j), (j, i)) if other in (row := rows[k]).kept and float(row.x[i])]
        best = min(own, key=lambda row: row.left, default=None)
        if best is not None and float(best.x[j]):
            ratio = -float(best.x[i] / best.x[j])
            if data.units[i] != data.units[j] or _number(ratio, 3) != "1.":
                found[i + 1, j + 1] = _number(ratio, 7)
    return found


def _shafts(data: Trajectories) -> list[bool]:
    """Whether each coordinate is measured in rad and goes through 2π or more."""
    ranges = (data.q.amax(0) - data.q.amin(0)).tolist()
    return [unit == "rad" and x >= 2 * math.pi for unit, x in zip(data.units, ranges, strict=True)]


def sizes(data: Trajectories) -> dict[tuple[int, int], str]:
    """The ratio of the sizes of coordinates i < j, counted from 1, of different units.

    Of many coordinates a force between two need not be of ρ q_i − q_j alone, as of a body on two springs. Without any
    ratio a force on the smaller coordinate would be a small difference of large terms.
    """
    pairs = combinations(range(data.dof), 2)
    return {
        (i + 1, j + 1): _number(float(data.balance[j] / data.balance[i]), 3)
        for i, j in pairs if data.units[i] != data.units[j]
    }  # fmt: skip


def _number(x: float, digits: int) -> str:
    """A number with a point or an exponent, as `rates` reads the numbers of a term."""
    text = f"{x:.{digits}g}"
    return text if "." in text or "e" in text else f"{text}."


class _Row(NamedTuple):
    """The regression of an acceleration: coefficients x, other positions `kept` by it, and the share `left` of it."""

    x: Tensor  # (n + m + 2,) of positions, 1, the own velocity and inputs; (2n + m + 1,) with all velocities
    kept: list[int]
    left: float


def _regressions(data: Trajectories, *, dampers: bool = False) -> list[_Row] | None:
    """The regressions of all accelerations, with `dampers` on all velocities; None if there are too few samples."""
    data = data.to(torch.float64, "cpu")
    local = local_polynomials(data)
    if local is None:
        return None
    n, overlap = data.dof, local.width / 2
    half = local.half[local.centred, None]
    q, v, a = (local.coefficients[local.centred, k] * math.factorial(k) / half**k for k in range(3))
    u = data.q.new_zeros(data.samples, 0) if data.u is None else data.u
    count, unknowns = len(q) / overlap, u.shape[1] + (2 * n + 1 if dampers else n + 2)
    if count <= unknowns:
        return None
    worth, rows = math.log(count) + 2 * math.log(max(n - 1, 1)), []
    for i in range(n):
        X = torch.cat([q, torch.ones_like(half), v if dampers else v[:, i, None], u[local.centred]], 1)
        x = least_squares(X, a[:, i, None])[:, 0]
        left = float((a[:, i] - X @ x).square().mean())
        others = torch.tensor([j for j in range(n) if j != i])
        kept = prune(X.T @ X, x, others, worth * overlap * left / (1 - unknowns / count))[0]
        rows.append(_Row(x, kept.tolist(), left / float(a[:, i].var(correction=0).clamp_min(1e-300))))
    return rows


def terms_between(coupled: Collection[tuple[int, int]], angles: Sequence[bool]) -> tuple[str, ...]:
    """The features of the dictionary `lengths` that are of one coordinate, or of two in these pairs."""
    on = {name: _coordinates(name, angles) for name in lengths(angles)}
    return tuple(name for name, own in on.items() if len(own) == 1 or own in coupled)


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
