"""The terms of inputs that a search offers, and the levels at which inputs saturate.

A level is found in two steps. By least squares, terms of the inputs and a few terms of each coordinate explain the
smoothed accelerations; the level with the least residual is the first guess. Near that guess the model with the terms
that were taken is fitted at other levels; the level with the least misfit is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.input_terms import SATURATIONS, all_input_terms, saturation
from herglotz.data.smoothing import smoothed
from herglotz.least_squares import least_squares
from herglotz.models.drag import input_columns, input_forces
from herglotz.training.baseline import acceleration_terms, for_each
from herglotz.training.dictionary import by_motion
from herglotz.training.kernel import MAX_PARAMETERS
from herglotz.training.offers import INPUTS, ZEROS
from herglotz.training.search import Search
from herglotz.training.trials import Trial, Variant

# Levels of an input that are tried, and the least level over the largest value of the input.
LEVELS, LOWEST = 24, 0.05
# Factor between the first levels that are tried beside a guess.
AROUND = 1.5
# Parabolas of the misfit through three levels, and how much closer the levels are from one to the next: 0.5 % at last.
PARABOLAS, SHRINKS = 3, 1 / 9


def offered_terms(data: Trajectories) -> tuple[str, ...]:
    """Squares, sizes and rates of the inputs, both saturations of each at the level that accelerations ask for, and
    their forces that depend on the motion.
    """
    plain = all_input_terms(data)
    if not plain or data.u is None:
        return ()
    found = acceleration_terms(smoothed(data))
    a, row = found.a, found.triples.index + 1
    terms = []
    for j, (name, _) in enumerate(data.input_labels):
        u, (least, most) = data.u[row, j], _range_of_levels(data.u[:, j])
        levels = [most * (least / most) ** (k / LEVELS) for k in range(1, LEVELS + 1)] if most > 0 else []
        for kind, shape in SATURATIONS.items() if levels else ():
            left = [_left(found.columns, shape(u / level), a) for level in levels]
            terms.append(f"{kind}({name}/{levels[left.index(min(left))]:.4g})")
    return (*plain, *terms, *by_motion(data.angles, range(1, len(data.input_labels) + 1)))


def _range_of_levels(u: Tensor) -> tuple[float, float]:
    """The least and the largest level at which an input (N,) may saturate.

    Below the smallest value of an input of one sign a saturation is a constant force.
    """
    size = u.abs()
    return max(LOWEST * float(size.max()), float(size.min())), float(size.max())


def _left(columns: Tensor, more: Tensor, a: Tensor) -> float:
    """Mean square of accelerations (T, n) after a fit of columns (T, n, k) and `more` (T,) of each coordinate."""
    A = torch.cat([columns, for_each(more[:, None, None].expand(-1, a.shape[1], 1))], -1).flatten(0, 1)
    size = A.square().mean(0).sqrt().clamp_min(torch.finfo(A.dtype).tiny)
    y = a.reshape(-1, 1)
    return float((A / size @ least_squares(A / size, y) - y).square().mean())


def asked_terms(search: Search, trial: Trial) -> tuple[str, ...]:
    """The terms of the inputs that a model takes if all are offered; () if the model is no better than the trial.

    Each level counts as one more number of the model. A trial at the noise whose misfit is white lacks no terms.
    """
    every = () if trial.lacks_nothing or not search.config.find_input_terms else offered_terms(search.data)
    if not (every := _in_a_kernel(search, every)):
        return ()
    found = _with(search, every, trial)
    if found is None or not found.replaces(trial):
        return ()
    if any(map(saturation, taken_terms(found, every))):
        # Saturations of both kinds look alike, and like a square if an input has one sign. The levels were guesses:
        # each kind is tried alone, at its best level, and so are the terms without a level.
        each = [_of_kind(search, kind, every, trial) for kind in (*SATURATIONS, "")]
        for of, other in each:
            if other is not None and search.better(found, other) is other:
                every, found = of, other
    taken = taken_terms(found, every)
    return taken if found.gain(trial, sum(map(bool, map(saturation, taken)))) > 0 else ()


def _in_a_kernel(search: Search, every: tuple[str, ...]) -> tuple[str, ...]:
    """The terms without forces by the motion, or without saturations too, that a kernel has room for; () if it has not.

    Without a kernel, a fit of three joints with all terms of their inputs takes minutes.
    """
    still = tuple(term for term in every if term not in input_forces(every))
    plain = tuple(term for term in still if saturation(term) is None)
    room = (own for own in (every, still, plain) if own and _numbers(search, own) <= MAX_PARAMETERS)
    return next(room, ())


def _numbers(search: Search, terms: Sequence[str]) -> int:
    """The number of parameters with these terms: a column of u has a gain for each coordinate and a zero."""
    columns = len(input_columns(terms))
    more = (search.data.dof + 1) * columns + len(terms) - columns
    return len(search.fitter(Variant(search.order)).start) + more


def _with(search: Search, terms: Sequence[str], trial: Trial) -> Trial | None:
    """A model with these terms of the inputs among its offers.

    The terms join a trial that is near the data. Where that lacks something, they also join the simplest model over
    ever longer segments: a motion that is sensitive to its forces tells of them over short segments alone.
    """
    other, near = search.driven_by(terms), None
    if trial.near and (same := other.again(beside(trial, len(input_columns(terms))))) is not None:
        near = other.settled(other.finer(same))
    if near is not None and near.lacks_nothing:
        return near
    fitter = other.fitter(Variant(search.order))
    return other.better(near, other.climbed(fitter, fitter.simple, {}))


def _of_kind(search: Search, kind: str, terms: Sequence[str], trial: Trial) -> tuple[tuple[str, ...], Trial | None]:
    """The terms with one kind of saturation, at the levels at which their model misses the data least, and the model.

    None if no path is found.
    """
    every = tuple(term for term in terms if (of := saturation(term)) is None or of[0] == kind)
    found = _with(search, every, trial)
    # Terms that were taken at a wrong level are not those that are taken at a better one, where another level is best.
    while found is not None and (better := _sharper(search, every, found)) is not None:
        every, found = better
    return every, found


def _sharper(search: Search, every: tuple[str, ...], found: Trial) -> tuple[tuple[str, ...], Trial] | None:
    """The terms at the levels at which a model misses the data least, and the model settled there; None if no better.

    An input that saturates need not act beside its saturation, though it makes up for a wrong level.
    """
    names, taken = [name for name, _ in search.data.input_labels], taken_terms(found, every)
    alone = {names.index(of[2]) for term in taken if (of := saturation(term))}
    beside_it = {name for name in found.taken if name.startswith(INPUTS) and _column(name, found) in alone}
    best: tuple[tuple[str, ...], Trial] = every, found
    for own in dict.fromkeys((found.taken, found.taken - beside_it)) if alone else ():
        every = sharpened(search, replace(found, taken=own), every)
        other = search.driven_by(every)
        again = other.again(replace(found, taken=own))
        if again is not None and search.better(best[1], settled := other.settled(again)) is settled:
            best = every, settled
    return best if best[1] is not found else None


def beside(trial: Trial, more: int) -> Trial:
    """The trial with its input coefficients renamed for so many more inputs."""
    columns = len(trial.fitter.data.input_labels)
    if not more:
        return trial

    def renamed(name: str) -> str:
        stem, _, place = name.partition("[")
        row, column = divmod(int(place.rstrip("]") or 0), columns) if stem in (INPUTS, ZEROS) else (0, 0)
        return {INPUTS: f"{INPUTS}[{row * (columns + more) + column}]", ZEROS: f"{ZEROS}[{column}]"}.get(stem, name)

    values = {renamed(name): x for name, x in trial.values.items()}
    return replace(trial, taken=frozenset(map(renamed, trial.taken)), values=values)


def taken_terms(found: Trial, every: Sequence[str]) -> tuple[str, ...]:
    """Those terms of `every` that a model has taken; the last inputs of its data are those that are columns."""
    columns, own = len(found.fitter.data.input_labels), input_columns(every)
    gains = (_column(name, found) for name in found.taken if name.startswith(INPUTS))
    recorded, forces = columns - len(own), set(input_forces(every)) & found.taken
    taken = {own[k - recorded] for k in gains if k >= recorded} | forces
    return tuple(term for term in every if term in taken)


def _column(gain: str, found: Trial) -> int:
    """The column of u that a gain belongs to; the only gain of a model has no number."""
    return int(gain.partition("[")[2].rstrip("]") or 0) % len(found.fitter.data.input_labels)


def sharpened(search: Search, found: Trial, every: Sequence[str]) -> tuple[str, ...]:
    """The terms; those that a model has taken have the levels at which the model misses the data of a search least.

    The model may have been found with other levels, or with other zeros of sensors.
    """
    terms = list(every)
    for term in taken_terms(found, every):
        if (of := saturation(term)) is None:
            continue
        kind, level, name = of
        place = terms.index(term)
        # Far above the largest input a saturation is the input itself, and far below it a sign.
        labels = [label for label, _ in search.data.input_labels]
        assert search.data.u is not None
        least, most = _range_of_levels(search.data.u[:, labels.index(name)])

        def missed(
            x: float, place: int = place, start: str = f"{kind}({name}/", least: float = least, most: float = most
        ) -> float:
            if not least <= math.exp(x) <= most / LOWEST:
                return math.inf
            terms[place] = f"{start}{math.exp(x):.5g})"
            fit = search.driven_by(terms).again(found)
            # Shorter segments are missed by less at any level.
            return math.inf if fit is None or fit.length < found.length else fit.rms**2

        missed(_least(missed, math.log(level), math.log(AROUND)))
    return tuple(terms)


def _least(f: Callable[[float], float], x: float, step: float) -> float:
    """The minimum of f near x, by parabolas through three points each, which are closer from parabola to parabola."""
    for _ in range(PARABOLAS):
        low, middle, high = f(x - step), f(x), f(x + step)
        # Downhill until the lowest point is in the middle.
        while min(low, high) < middle:
            if low < high:
                x, low, middle, high = x - step, f(x - 2 * step), low, middle
            else:
                x, low, middle, high = x + step, middle, high, f(x + 2 * step)
        x, step = _lowest(x, step, low, middle, high), step * SHRINKS
    return x


def _lowest(x: float, step: float, low: float, middle: float, high: float) -> float:
    """The lowest point, within a step of x, of the parabola through three points a step apart; x if it has none."""
    bend = low - 2 * middle + high
    if not 0 < bend < math.inf:
        return x
    return x + step * max(-1.0, min(1.0, (low - high) / (2 * bend)))
