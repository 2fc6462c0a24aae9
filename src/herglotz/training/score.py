"""The one comparison of a fit: what a model misses held-out blocks of time by, and whether a richer one is worth it.

A richer model of k_r numbers, which come in c_r of C offers, replaces a simpler one of k_s where

    Σ_b (ℓ_b(simple) − ℓ_b(rich)) > τ [½ (k_r − k_s) log (N/τ) + log C(C, c_r) − log C(C, c_s)] + e/√τ,

and more than e, the standard error of this sum over blocks; ℓ_b is the log-loss of block b by Student's t, had its
samples been left out of the fit. τ is how many samples in a row tell as much as one (`correlation_time`), so that N
numbers are worth N/τ independent ones; e/√τ is what e would be if they all were. Where a model lacks nothing its
residuals are white, τ is 1, and without e this is the extended Bayesian information criterion (Chen & Chen 2008).
Residuals that are no noise go on from sample to sample, τ is large, and every further number is dear. Lost blocks and
outliers weigh little: the loss of Student's t grows as log |r|.
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
    correlation_time: float = 1.0  # τ, in samples
    zeros: int = 0  # further numbers, which are one choice for all: zeros of sensors

    def replaces(self, simple: Score, offered: int) -> bool:
        """Whether this richer model replaces a simpler one, where there are so many offers."""
        return self.gain(simple, offered) > 0

    def gain(self, simple: Score, offered: int) -> float:
        """The left side of the inequality less the larger right one, τ being that of the richer model."""
        by_block = simple.losses - self.losses
        error = float(by_block.std()) * len(by_block) ** 0.5
        dearer = self.price(self, offered) - self.price(simple, offered)
        return float(by_block.sum()) - max(dearer + error / self.correlation_time**0.5, error)

    def price(self, model: Score, offered: int) -> float:
        """What the numbers and the choices of a model cost at the τ of this one, where there are so many offers."""
        chosen = math.log(math.comb(offered, model.choices))
        return (model.numbers + model.zeros) * self.of_a_number + self.correlation_time * chosen

    @property
    def of_a_number(self) -> float:
        """½ τ log (N/τ), what a number costs."""
        return self.correlation_time * math.log(self.count / self.correlation_time) / 2


def scores(
    model: HeldOut, sets: Sequence[Sequence[int]], choices: Sequence[int], count: int, floor: float
) -> list[Score]:
    """The scores of sets of the numbers of a fit, to first order; `choices` (C,) offers have brought them.

    Misfits below `floor`, in units of q over the balance, are rounding.
    """
    block = torch.where(model.complete, model.block, -1)
    of_misfits = _of_misfits(model.residuals(sets), block, floor)
    rest = zip(of_misfits, model.told(sets).sum(1).tolist(), choices, strict=True)
    return [Score(losses, count, numbers, chosen, error, time) for (losses, error, time), numbers, chosen in rest]


def fitted_score(problem: ShootingProblem, path: Path, floor: float, zeros: int = 0) -> Score:
    """The score by the residuals of the fit itself, block by block, of models that are alike but for a few numbers.

    What leaving out a block does to a model of many numbers, to first order, says more of these than of the few.
    """
    block = torch.where(problem.data.complete, blocks(problem.data), -1)
    ((losses, rms, time),) = _of_misfits(problem.misfit(path)[None], block, floor)
    return Score(losses, int((problem.weight > 0).sum()), problem.P, 0, rms, time, zeros)


def free_run_score(problem: ShootingProblem, path: Path, numbers: float, floor: float) -> Score:
    """The score over the samples that a fit has not used, which a free run over whole trajectories foretells.

    The few models that are compared so have paid for their choices.
    """
    unseen = ~problem.used & problem.data.complete
    block = torch.where(unseen, torch.cumsum(unseen, 0) - 1, 0) * BLOCKS // max(1, int(unseen.sum()))
    ((losses, rms, time),) = _of_misfits(problem.misfit(path)[None], torch.where(unseen, block, -1), floor)
    return Score(losses, int(unseen.sum()) * problem.n, numbers, 0, rms, time)


def _of_misfits(r: Tensor, block: Tensor, floor: float) -> list[tuple[Tensor, float, float]]:
    """Log-losses (B,), RMS and τ of each of C sets of residuals (C, N, n) over the balance, alike below `floor`.

    Of samples in blocks (N,); those in block −1 are in none.
    """
    inside = block >= 0
    r, block = r[:, inside], block[inside]
    scale = _scale(r).clamp_min(floor)
    x = r.abs().clamp_min(floor) / scale
    loss = scale.log() + (FREEDOM + 1) / 2 * torch.log1p(x.square() / FREEDOM)
    loss = loss.nan_to_num(nan=WORST, posinf=WORST).sum(2)
    losses = torch.zeros(len(r), int(block.max()) + 1, dtype=r.dtype, device=r.device).index_add_(1, block, loss)
    rms, time = r.square().mean((1, 2)).sqrt().tolist(), correlation_time(r / scale).tolist()
    return list(zip(losses, rms, time, strict=True))


def correlation_time(x: Tensor) -> Tensor:
    """Samples in a row that tell as much as one, of residuals (C, N, n) over their scale, (C,): 1 of white ones.

    τ = 1 + 2 Σ ρ_k, ρ_k being the autocorrelation at lag k of what a residual pulls with, the slope of its loss by
    Student's t. Lags are added up in pairs as long as the pairs are positive (Geyer 1992).
    """
    pull = (x / (FREEDOM + x.square())).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    N = x.shape[1]
    power = torch.fft.rfft(pull, 2 * N, dim=1).abs().square().sum(2)
    covariance = torch.fft.irfft(power, 2 * N)[:, : N // 2 * 2]
    rho = covariance / covariance[:, :1].clamp_min(torch.finfo(x.dtype).tiny)
    pairs = rho.unflatten(1, (-1, 2)).sum(2)
    positive = (pairs > 0).cumprod(1)
    return (2 * (pairs * positive).sum(1) - 1).clamp_min(1.0)


def _scale(r: Tensor) -> Tensor:
    """Scale of Student's t at which residuals (C, N, n) of each coordinate are likeliest, (C, 1, n).

    By expectation and maximisation with an expanded parameter (Liu, Rubin & Wu 1998), which takes far fewer rounds.
    """
    squared, v = r.square(), FREEDOM
    tiny = torch.finfo(r.dtype).tiny
    s = squared.median(1, keepdim=True).values.clamp_min(tiny)
    # Σ w r² / Σ w with the weights w = 1 / (v + r²/s).
    for _ in range(ROUNDS):
        before = s
        s = (r.shape[1] / (squared + v * s).reciprocal_().sum(1, keepdim=True) - v * s).clamp_min(tiny)
        if bool(((s - before).abs() <= SETTLED * s).all()):
            break
    return s.sqrt()
