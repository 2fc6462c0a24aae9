"""A model of named terms with its fit to whole trajectories, and what its misfit looks like."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from herglotz.training.arrowhead import dense
from herglotz.training.baseline import Baseline
from herglotz.training.config import FitConfig
from herglotz.training.cross_validation import MARGIN
from herglotz.training.named_terms import DRY, NamedTerms, places
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.problems.zeros import WithZeros
from herglotz.training.pruning import inverse_of, prune
from herglotz.training.trajectory_fit import TrajectoryFit

COLOURED = 3.0  # standard deviations of white noise's autocorrelation


def gain(rms: float, other: float, count: int, floor: float) -> float:
    """By how much the other misfit of so many numbers is likelier, in log-likelihood; below `floor` all are alike."""
    return count * math.log(max(rms, floor) / max(other, floor))


@dataclass(frozen=True)
class Found:
    """A model of named terms with its fit."""

    terms: NamedTerms
    config: FitConfig
    values: dict
    base: Baseline
    fit: TrajectoryFit
    whole: bool  # every trajectory is one segment, and followed
    spread: float  # of q, RMS
    every: int = 1  # how many samples of the data are one of the fit's

    @property
    def rms(self) -> float:
        """Misfit of the data, in units of q."""
        return self.fit.noise

    @property
    def pushes(self) -> bool:
        """Whether its dry friction drives every coordinate, which none does: it would create energy."""
        return self.terms.dry and max(self.values[DRY]) <= 0

    @cached_property
    def held_out(self) -> Tensor:
        """RMS over held-out blocks of time, (FOLDS,)."""
        return self.fit.held_out_errors()

    @property
    def coloured(self) -> bool:
        """Whether the misfit goes on from sample to sample, by its autocorrelation: white noise has 0 ± 1/√N."""
        problem = self.fit.problem
        r = problem.misfit(self.fit.path)
        together = problem.data.trajectory[1:] == problem.data.trajectory[:-1]
        with_next = (r[1:] * r[:-1]).sum(-1)[together].sum() / r.square().sum().clamp_min(1e-300)
        return float(with_next) > COLOURED / r.numel() ** 0.5

    def information(self, floor: float) -> tuple[Tensor, Tensor]:
        """All unknowns, and JᵀJ of residuals over their RMS; misfits below `floor` are rounding."""
        problem = self.fit.problem
        x = problem.pack(self.fit.theta, self.fit.path.x[:, 0, : problem.d])
        return x, dense(problem.normal_equations(x)[1]) * (problem.sigma / max(self.rms, floor)) ** 2

    def needed(self, worth: float, simplest: Collection[str], floor: float, *, one_less: bool = False) -> NamedTerms:
        """The terms worth so much by the quadratic model of the fit, or all but the one that is worth least.

        The `simplest` go only where no other one can; misfits below `floor` are rounding.
        """
        at = places(self.fit.problem.parameters)
        if not at:
            return self.terms
        x, A = self.information(floor)
        free = torch.tensor([i for own in at.values() for i in own])
        late = torch.tensor([i for name in simplest for i in at.get(name, ())], dtype=torch.long)
        stay = set(prune(A, x, free, worth, len(free) - 1 if one_less else 0, late)[0].tolist())
        return self.terms.only([name for name, own in at.items() if stay & set(own)])

    def cost_without(self, names: Sequence[str], floor: float) -> float:
        """Twice what the absence of these parameters costs by the quadratic model of the fit."""
        x, A = (y.double() for y in self.information(floor))
        at = torch.cat([self.fit.problem.parameters.index(name) for name in names])
        own = inverse_of(A)[at][:, at]
        return float(x[at] @ torch.linalg.pinv(own, hermitian=True) @ x[at])

    def beaten_by(self, other: Found, floor: float) -> bool:
        """Whether the other one errs less over held-out blocks, by more than a twentieth and more than rounding."""
        # their spread has no say: it is wide where errors grow with time, as on an axis without a spring
        own, its = (float(f.held_out.clamp_min(floor).square().mean().sqrt()) for f in (self, other))
        return not own <= MARGIN * its

    def joined_by(self, more: Found, floor: float) -> bool:
        """Whether one more term stays, which was proposed as if the cost were quadratic and misfits noise."""
        halved = more.rms < self.rms / 2**0.5  # squared; blocks of time are foretold to first order alone
        if self.coloured and more.coloured:
            return halved or (more.rms < self.rms and self.beaten_by(more, floor))
        count = self.fit.problem.data.q.numel()
        return gain(self.rms, more.rms, count, floor) > math.log(count) / 2

    @property
    def halved_before(self) -> bool:
        """Whether steps of several coordinates, which cost more, are halved ones, and a force is missing still."""
        return self.coloured and self.config.substeps > 1 and self.fit.problem.n > 1

    def worth_halving(self, finer: Found, floor: float) -> bool:
        """Whether the same terms with shorter steps are worth their time.

        They may miss as much, for the terms may have made up for longer steps; where steps were halved before, they
        have to miss less by a twentieth.
        """
        count = self.fit.problem.data.q.numel()
        worth = count * math.log(MARGIN) if self.halved_before else -math.log(count) / 2
        return gain(self.rms, finer.rms, count, floor) > worth

    def as_good(self, other: Found, floor: float) -> bool:
        """Whether these terms miss held-out blocks as little as the other ones, and all data by less than √2 times."""
        return self.rms <= 2**0.5 * max(other.rms, floor) and not self.beaten_by(other, floor)

    def misses_less(self, other: Found | None) -> bool:
        """Whether it misses less than the other one, if there is any, over segments that are as long."""
        return other is None or (self.whole >= other.whole and self.rms < other.rms)

    def instead_of(self, other: Found, floor: float) -> bool:
        """Whether these terms, which are fewer, take the place of the other ones.

        Of residuals that are no noise likelihoods tell nothing.
        """
        return self.whole and self.as_good(other, floor) if other.coloured else self.as_likely(other, floor)

    def as_likely(self, other: Found, floor: float) -> bool:
        """Whether fewer numbers follow as long segments, and miss the data by no more than the others are worth."""
        count, fewer = self.fit.problem.data.q.numel(), len(other.fit.theta) - len(self.fit.theta)
        longer = self.fit.problem.grid.length >= other.fit.problem.grid.length
        return longer and gain(self.rms, other.rms, count, floor) < fewer * math.log(count) / 2

    def changed_by(self, problem: ShootingProblem) -> float:
        """RMS change of the fitted motion by the steps of another problem with the same terms and segments."""
        fit = self.fit
        path = problem.solve(problem.pack(fit.theta, fit.path.x[:, 0, : problem.d]))
        if path is None:
            return math.inf
        change = problem.misfit(path) - fit.problem.misfit(fit.path)
        return float(change.square().mean().sqrt())

    @property
    def apart(self) -> bool:
        """Whether zeros of sensors that differ between recordings stay where terms are left out by the quadratic model.

        Terms go before zeros: they may make up for zeros that they have not been given.
        """
        problem, fit = self.fit.problem, self.fit
        if len(problem.data) == 1:
            return False
        target, x = WithZeros(problem), problem.pack(fit.theta, fit.path.x[:, 0, : problem.d])
        x = torch.cat([x, x.new_zeros(target.count)])
        cost, A, b = target.normal_equations(x)
        if not bool(torch.isfinite(cost)):
            return False
        at = torch.arange(len(x))
        zeros, states = at[-target.count :], at[problem.P : -target.count]
        rest = torch.cat([at[: problem.P], zeros])
        C, singular = torch.linalg.solve_ex(A[states][:, states], torch.cat([A[states][:, rest], b[states, None]], 1))
        if int(singular):  # a joint that dry friction holds does not tell its speed
            return False
        S, slope = A[rest][:, rest] - A[rest][:, states] @ C[:, :-1], b[rest] - A[rest][:, states] @ C[:, -1]
        best = x[rest] - torch.linalg.pinv(S, hermitian=True) @ slope
        terms = torch.tensor([i for own in places(problem.parameters).values() for i in own], dtype=torch.long)
        last = torch.arange(problem.P, len(rest))
        S = S * (problem.sigma / self.rms) ** 2
        kept, _ = prune(S, best, torch.cat([terms, last]), math.log(problem.data.q.numel()), simplest=last)
        return bool((kept >= problem.P).any())
