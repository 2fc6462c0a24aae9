"""The linear start of a search for named terms: all candidates fitted to smoothed positions, then pruned."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.smoothing import LocalPolynomials, smooth_triples
from herglotz.training.baseline import Baseline
from herglotz.training.cross_validation import MARGIN
from herglotz.training.linear_start import SHARED, LinearFit
from herglotz.training.named_terms import MOVING, STILL, NamedTerms, by_term, central, chains, holders, own_terms
from herglotz.training.pruning import prune

# Most triples in the linear problem.
MAX_TRIPLES = 4000
SPRINGS = ("potential.stiffness", "potential.tilt")
# Least eigenvalue of a mass matrix scaled to a unit diagonal, and the most reductions by a tenth to reach it.
MIN_EIGENVALUE, MAX_REDUCTIONS = 0.1, 20
# Least number of residuals per coefficient: with fewer, noise determines the smallest singular value.
MIN_RESIDUALS = 5


class LinearStart(NamedTuple):
    """The solution of a linear problem: terms, and values by the name of a term or of a parameter.

    `error` is the RMS of J⁻¹R over the triples, in units of q; `size` the number of all coefficients, with masses,
    springs and friction.
    """

    terms: NamedTerms
    values: dict
    error: float
    size: int


def start_of(data: Trajectories, base: Baseline, every: NamedTerms, local: LocalPolynomials) -> LinearStart | None:
    """The likeliest start, from all candidates or from the smaller families of chains; None if no mass fits.

    The Bayesian information criterion chooses. With many candidates noise leaves some so poorly determined that no mass
    fits, or that useless terms stay. The best start with one power of the distance replaces the chosen one if its error
    is smaller, or about equal with fewer coefficients.
    """
    families = (every, *(replace(every.only(x.names), apart=x.apart) for x in chains(data)))
    one_of = central(data, every)
    problem = LinearTerms(data, base, reduce(NamedTerms.joined, [*families, *one_of]), local)
    starts = (start for terms in families if (start := problem.start(terms)) is not None)
    tried = sorted({start.terms: start for start in starts}.values(), key=lambda start: start.size)
    first = tried[problem.likeliest(tried)] if tried else None
    others = [start for terms in one_of if (start := problem.start(terms)) is not None and start.terms.features]
    other = min(others, key=lambda start: start.error, default=None)
    return first if other is None or (first is not None and _better(first, other)) else other


def _better(first: LinearStart, other: LinearStart) -> bool:
    """True if the error of the first start is smaller; with more coefficients it has to be smaller by a twentieth."""
    return first.error * (MARGIN if first.size > other.size else 1 / MARGIN) < other.error


class LinearTerms:
    """Terms and starting values from smoothed positions: `every` holds the candidates of all families."""

    def __init__(self, data: Trajectories, base: Baseline, every: NamedTerms, local: LocalPolynomials):
        self.data, self.base, self.all = data, base, every
        self.own = own_terms(data.angles)
        self.held = holders([x for x in every.features if x not in self.own], every.drag)
        self.overlap = max(1.0, local.width / 2)
        self.fit = self._problem(local)
        terms = {parameter: iter(names) for parameter, names in self.held.items()}
        # Names of the columns: terms, or parameters.
        self.names = [next(terms[x]) if x in terms else x for x in self.fit.names]
        # Number of independent residuals.
        self.count = max(3, int(self.fit.R[..., 0].numel() / self.overlap))

    def start(self, of: NamedTerms) -> LinearStart | None:
        """The terms of a family that the linear problem needs, with their values; None if no mass fits."""
        fit, columns = self.fit, self._columns(of)
        if fit.R[..., 0].numel() < MIN_RESIDUALS * int(columns.sum()):
            return None
        x = fit.solve(columns)
        if float(x[0]) == 0:
            return None
        x = x / x[0]
        r = fit.errors(x)
        if not bool(torch.isfinite(r).all()):
            return None
        terms, left, alone = self._pruned(of, columns, x, r)
        for x in (fit.solve(left), alone):
            start = fit.start(self._regular(x))
            if start is not None:
                error = float(fit.errors(x).square().mean().sqrt())
                return LinearStart(terms, self._named(start), error, int(left.sum()))
        return None

    def likeliest(self, starts: Sequence[LinearStart]) -> int:
        """The place of the start with the best Bayesian information criterion."""
        of = [self.count * math.log(max(x.error, 1e-300)) + x.size * math.log(self.count) / 2 for x in starts]
        return min(range(len(of)), key=of.__getitem__)

    def _regular(self, x: Tensor) -> Tensor:
        """The coefficients with smaller masses that depend on angles, until no mass matrix is nearly singular.

        Smoothing may make these masses too large for steps to have a solution. If other masses are the cause, keep x.
        """
        less, moving = x.clone(), torch.tensor([name == MOVING for name in self.fit.names])
        for _ in range(MAX_REDUCTIONS if bool(moving.any()) else 0):
            M = -(self.fit.J @ less) * x[0].sign()
            size = M.diagonal(dim1=-2, dim2=-1).abs().clamp_min(1e-300).sqrt()
            M = (M + M.mT) / 2 / size[:, :, None] / size[:, None, :]
            if bool(torch.isfinite(M).all()) and float(torch.linalg.eigvalsh(M).min()) > MIN_EIGENVALUE:
                return less
            less[moving] *= 0.9
        return x

    def _problem(self, local: LocalPolynomials) -> LinearFit:
        """The linear problem of all candidates over the smoothed samples."""
        t, u = smooth_triples(self.data, local)
        if len(t) > MAX_TRIPLES:
            rows = torch.linspace(0, len(t) - 1, MAX_TRIPLES).round().long()
            t, u = t.spread_out(MAX_TRIPLES), None if u is None else u[rows]
        features, dry = (*self.held[STILL], *self.held[MOVING]), self.base.speed if self.all.dry else ()
        return LinearFit.of(self.data.angles, features, t, self.data.balance, drag=self.all.drag, dry=dry, u=u)

    def _pruned(self, of: NamedTerms, columns: Tensor, x: Tensor, r: Tensor) -> tuple[NamedTerms, Tensor, Tensor]:
        """The terms that the errors r justify, the remaining columns, and coefficients refitted without the others.

        Samples that share half a smoothing window are dependent: the number of samples is divided by the overlap.
        """
        fit, overlap = self.fit, self.overlap
        X = torch.linalg.solve_ex(fit.J @ x, fit.R)[0].flatten(0, 1)[:, columns][:, 1:]
        size = r.square().mean().clamp_min((1e-9 * float((X * x[columns][1:]).abs().max())) ** 2 + 1e-300)
        place = self._linear_places(columns)
        free = torch.tensor([i for own in place.values() for i in own])
        simplest = torch.tensor([i for name in self.own for i in place.get(name, ())], dtype=torch.long)
        worth = math.log(self.count)
        kept, less = prune(X.T @ X / size / overlap, x[columns][1:], free, worth, simplest=simplest)
        stay = set(kept.tolist())
        terms = of.only([name for name, own in place.items() if stay & set(own)])
        left, at = columns.clone(), columns.nonzero()[1:, 0]
        for name, own in place.items():
            if name not in terms.names:
                left[at[own]] = False
        alone = torch.zeros_like(x)
        alone[at], alone[columns.nonzero()[0]] = less, 1.0
        return terms, left, alone

    def _named(self, start: dict[str, Tensor]) -> dict:
        """Starting values by the name of a term or of a parameter."""
        values = by_term(start, self.held)
        return values | {term: by * values.pop(parameter)[0] for term, (parameter, by) in self.own.items()}

    def _columns(self, of: NamedTerms) -> Tensor:
        """Columns of a family, masses, springs and friction; joints are coupled unless `apart`."""
        joints = any(self.data.angles) and not of.apart

        def used(name: str) -> bool:
            if name in SPRINGS:
                return of.springs
            return name in of.names if name in self.all.names else joints or name not in (SHARED, "coupling.viscous")

        return torch.tensor([used(name) for name in self.names])

    def _linear_places(self, columns: Tensor) -> dict[str, list[int]]:
        """Places of each term among the columns in use, without the first mass."""
        own = {parameter: term for term, (parameter, _) in self.own.items()}
        left = [own.get(self.names[k], self.names[k]) for k in columns.nonzero()[1:, 0].tolist()]
        at: dict[str, list[int]] = {}
        for i, name in enumerate(left):
            if name in self.all.names:
                at.setdefault(name, []).append(i)
        return at
