"""The terms of inputs that a search offers, and the levels at which inputs saturate.

A level is found twice: where terms of the inputs and a few of each coordinate, by least squares, leave the least of the
smoothed accelerations; and from there, where the model with the terms that it has taken misses the motion least.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.input_terms import SATURATIONS, all_input_terms, saturation
from herglotz.data.smoothing import smoothed
from herglotz.least_squares import least_squares
from herglotz.training.acceleration_terms import acceleration_terms, for_each
from herglotz.training.offers import INPUTS, ZEROS
from herglotz.training.trials import Trial, Variant

LEVELS = 24  # of an input, tried between a twentieth of its largest value and that
LOWEST = 0.05  # of the largest value of an input: the least level that is tried
AROUND = 1.5  # factor to either side of its first guess within which a level is sharpened
ROUNDS = 16  # of golden sections, which leave 0.05 % of that range
GOLDEN = (5**0.5 - 1) / 2  # of an interval, to its inner point


class Driven(Protocol):
    """A `herglotz.training.search.Search`."""

    data: Trajectories
    order: int

    def driven_by(self, terms: Sequence[str]) -> Any:
        """The same of data whose inputs act by these terms as well."""
        ...


def offered_terms(data: Trajectories) -> tuple[str, ...]:
    """Squares, sizes and rates of the inputs, and both saturations of each at the level that accelerations ask for."""
    plain = all_input_terms(data)
    if not plain or data.u is None:
        return ()
    found = acceleration_terms(smoothed(data))
    a, row = found.a, found.triples.index + 1
    terms = []
    for j, (name, _) in enumerate(data.input_labels):
        u, most = data.u[row, j], float(data.u[:, j].abs().max())
        levels = [most * LOWEST ** (k / LEVELS) for k in range(1, LEVELS + 1)] if most > 0 else []
        for kind, shape in SATURATIONS.items() if levels else ():
            left = [_left(found.columns, shape(u / level), a) for level in levels]
            terms.append(f"{kind}({name}/{levels[left.index(min(left))]:.4g})")
    return (*plain, *terms)


def _left(columns: Tensor, more: Tensor, a: Tensor) -> float:
    """What is left of accelerations (T, n) by columns (T, n, k) and one more (T,) with a coefficient a coordinate."""
    A = torch.cat([columns, for_each(more[:, None, None].expand(-1, a.shape[1], 1))], -1).flatten(0, 1)
    size = A.square().mean(0).sqrt().clamp_min(torch.finfo(A.dtype).tiny)
    y = a.reshape(-1, 1)
    return float((A / size @ least_squares(A / size, y) - y).square().mean())


def asked_terms(search: Driven, trial: Trial) -> tuple[str, ...]:
    """The terms of the inputs that a model with all of them among its offers has taken, if it is better than a trial.

    Each level is one more number of it.
    """
    every = offered_terms(search.data)
    if not every:
        return ()
    found = _with(search, every, trial)
    if found is None or not found.replaces(trial):
        return ()
    if any(map(saturation, _taken(found, every))):
        every = _sharpened(search, found, every)
    while 0 < len(taken := _taken(found, every)) < len(every):  # terms that made up for others leave with those
        fewer = _with(search, taken, trial)
        if fewer is None or found.replaces(fewer):
            break
        found, every = fewer, taken
    return taken if found.gain(trial, sum(map(bool, map(saturation, taken)))) > 0 else ()


def _with(search: Driven, terms: Sequence[str], trial: Trial) -> Trial | None:
    """A model with these terms of the inputs among its offers, which join a trial that is near the data.

    Else they join the simplest model over ever longer segments.
    """
    other = search.driven_by(terms)
    if trial.near and (same := other.again(beside(trial, len(terms)))) is not None:
        return other.settled(other.finer(same), swapped=True)
    fitter = other.fitter(Variant(search.order))
    return other.climbed(fitter, fitter.simple, {})


def beside(trial: Trial, more: int) -> Trial:
    """The trial with the names that its numbers of inputs have where there are so many more inputs."""
    columns = len(trial.fitter.data.input_labels)

    def renamed(name: str) -> str:
        stem, _, place = name.partition("[")
        row, column = divmod(int(place.rstrip("]") or 0), columns) if stem in (INPUTS, ZEROS) else (0, 0)
        return {INPUTS: f"{INPUTS}[{row * (columns + more) + column}]", ZEROS: f"{ZEROS}[{column}]"}.get(stem, name)

    values = {renamed(name): x for name, x in trial.values.items()}
    return replace(trial, taken=frozenset(map(renamed, trial.taken)), values=values)


def _taken(found: Trial, every: Sequence[str]) -> tuple[str, ...]:
    """The terms, of `every` one, whose gains are among the offers that a model has taken; its last inputs are they."""
    columns = len(found.fitter.data.input_labels)
    gains = (int(name.partition("[")[2].rstrip("]")) % columns for name in found.taken if name.startswith(INPUTS))
    recorded = columns - len(every)
    return tuple(every[k - recorded] for k in sorted(set(gains)) if k >= recorded)


def _sharpened(search: Driven, found: Trial, every: Sequence[str]) -> tuple[str, ...]:
    """The terms with the levels, of those that a model has taken, at which it misses the data least."""
    terms = list(every)
    for term in _taken(found, every):
        if (of := saturation(term)) is None:
            continue
        kind, level, name = of
        place = terms.index(term)

        def missed(x: float, place: int = place, start: str = f"{kind}({name}/") -> float:
            terms[place] = f"{start}{math.exp(x):.5g})"
            fit = search.driven_by(terms).again(found)
            return math.inf if fit is None else fit.rms

        missed(_least(missed, math.log(level / AROUND), math.log(level * AROUND)))
    return tuple(terms)


def _least(f: Callable[[float], float], low: float, high: float) -> float:
    """Where f is least between two numbers, by golden sections."""
    x, y = high - GOLDEN * (high - low), low + GOLDEN * (high - low)
    of_x, of_y = f(x), f(y)
    for _ in range(ROUNDS):
        if of_x < of_y:
            high, y, of_y = y, x, of_x
            x = high - GOLDEN * (high - low)
            of_x = f(x)
        else:
            low, x, of_x = x, y, of_y
            y = low + GOLDEN * (high - low)
            of_y = f(y)
    return x if of_x < of_y else y
