"""The one comparison of a fit: what a model misses held-out blocks of time by, and whether a richer one is worth it.

A richer model of k_r numbers, which come in c_r of C offers, replaces a simpler one where

    Σ_b (ℓ_b(simple) − ℓ_b(rich)) > ½ (k_r − k_s) log N + log C(C, c_r) − log C(C, c_s) + the standard error,

ℓ_b being the log-loss of block b by Student's t, had its samples been left out of the fit. Of white residuals this is
the extended Bayesian information criterion (Chen & Chen 2008). Where residuals are no noise, blocks differ, the
standard error grows, and it decides. Lost blocks and outliers weigh little: the loss of Student's t grows as log |r|.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.training.held_out import BLOCKS, HeldOut, blocks
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.solvers.lifted_newton import Path

ROUNDS, SETTLED = 20, 1e-6  # of the scale of Student's t, and the relative change that ends them
WORST = 1e3  # the loss of a residual that is no number


@dataclass(frozen=True)
class Score:
    """Log-losses of held-out blocks, and what decides beside them."""

    losses: Tensor  # (B,) sums over the samples of a block
    count: int  # N, numbers in q
    numbers: float  # k of the model: of those with a prior what the data tell
    choices: int  # c, how many offers it has taken
    rms: float  # of held-out residuals, in units of q over the balance
    zeros: int = 0  # further numbers, which are one choice for all: zeros of sensors

    def replaces(self, simple: Score, offered: int, errors: float = 1.0) -> bool:
        """Whether this richer model replaces a simpler one, where there are so many offers, by so many errors."""
        return self.gain(simple, offered, errors) > 0

    def gain(self, simple: Score, offered: int, errors: float = 1.0) -> float:
        """The left side of the inequality less the right one, with so many times the standard error."""
        by_block = simple.losses - self.losses
        error = float(by_block.std()) * len(by_block) ** 0.5
        return float(by_block.sum()) - self.price(offered) + simple.price(offered) - errors * error

    def price(self, offered: int) -> float:
        """½ k log N + log (C over c)."""
        chosen = math.log(math.comb(offered, self.choices))
        return (self.numbers + self.zeros) * math.log(self.count) / 2 + chosen


def scores(
    model: HeldOut, sets: Sequence[Sequence[int]], choices: Sequence[int], count: int, floor: float
) -> list[Score]:
    """The scores of sets of the numbers of a fit, to first order; `choices` (C,) offers have brought them.

    Misfits below `floor`, in units of q over the balance, are rounding.
    """
    block = torch.where(model.complete, model.block, -1)
    losses, rms = _losses(model.residuals(sets), block, floor)
    rest = zip(losses, model.told(sets).sum(1).tolist(), choices, rms.tolist(), strict=True)
    return [Score(own, count, numbers, chosen, error) for own, numbers, chosen, error in rest]


def fitted_score(problem: ShootingProblem, path: Path, floor: float, zeros: int = 0) -> Score:
    """The score by the residuals of the fit itself, block by block, of models that are alike but for a few numbers.

    What leaving out a block does to a model of many numbers, to first order, says more of these than of the few.
    """
    block = torch.where(problem.data.complete, blocks(problem.data), -1)
    (losses,), (rms,) = _losses(problem.misfit(path)[None], block, floor)
    return Score(losses, int((problem.weight > 0).sum()), problem.P, 0, float(rms), zeros)


def free_run_score(problem: ShootingProblem, path: Path, numbers: float, choices: int, floor: float) -> Score:
    """The score over the samples that a fit has not used, which a free run over whole trajectories foretells."""
    unseen = ~problem.used & problem.data.complete
    block = torch.where(unseen, torch.cumsum(unseen, 0) - 1, 0) * BLOCKS // max(1, int(unseen.sum()))
    block = torch.where(unseen, block, -1)
    (losses,), (rms,) = _losses(problem.misfit(path)[None], block, floor)
    return Score(losses, int(unseen.sum()) * problem.n, numbers, choices, float(rms))


def _losses(r: Tensor, block: Tensor, floor: float) -> tuple[Tensor, Tensor]:
    """Log-losses (C, B) and RMS (C,) of residuals (C, N, n) over the balance in blocks (N,); −1: in none."""
    inside = block >= 0
    r, block = r[:, inside], block[inside]
    scale = _scale(r).clamp_min(floor)
    loss = scale.log() + (FREEDOM + 1) / 2 * torch.log1p((r / scale).square() / FREEDOM)
    loss = loss.nan_to_num(nan=WORST, posinf=WORST).sum(2)
    losses = torch.zeros(len(r), int(block.max()) + 1, dtype=r.dtype, device=r.device).index_add_(1, block, loss)
    return losses, r.square().mean((1, 2)).sqrt()


def _scale(r: Tensor) -> Tensor:
    """Scale of Student's t at which residuals (C, N, n) of each coordinate are likeliest, (C, 1, n).

    By expectation and maximisation with an expanded parameter (Liu, Rubin & Wu 1998), which takes far fewer rounds.
    """
    squared, v = r.square(), FREEDOM
    tiny = torch.finfo(r.dtype).tiny
    s = squared.median(1, keepdim=True).values.clamp_min(tiny)
    for _ in range(ROUNDS):
        weight, before = 1 / (v + squared / s), s
        s = ((weight * squared).sum(1, keepdim=True) / weight.sum(1, keepdim=True)).clamp_min(tiny)
        if bool(((s - before).abs() <= SETTLED * s).all()):
            break
    return s.sqrt()
