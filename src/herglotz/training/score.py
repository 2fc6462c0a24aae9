"""The only comparison of two models: their log-losses over held-out blocks of time, and the price of more numbers.

A rich model with k_r parameters, chosen as c_r of C offers, replaces a simple model with k_s and c_s if

    Σ_b (ℓ_b(simple) − ℓ_b(rich)) > τ [½ (k_r − k_s) log (N/τ) + log C(C, c_r) − log C(C, c_s)] + e/√τ

and if the sum also exceeds e, its standard error over blocks of time. ℓ_b is the log-loss of block b under Student's t
for a fit without the samples of the block. τ is the correlation time of the residuals of the rich model's fit to all
samples, in samples (`correlation_time`): N correlated values carry the information of N/τ independent values, for which
the standard error would be e/√τ. The log-loss of the fit to all samples must fall, too: by more than the bracket and
the standard error of that fall.

* White residuals have τ = 1. Without e the inequality is then the extended Bayesian information criterion
  (Chen & Chen 2008).
* Without a block, a simple model may be ill-determined. If a rich model meets all samples no better, no sample speaks
  for its further numbers, however much better it predicts the block.
* If a force is missing, residuals are correlated from sample to sample, τ is large, and each parameter costs more.
* Lost blocks and outliers have little weight, because the loss of Student's t grows only as log |r|.
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

# Iterations for the scale of Student's t, and the relative change at which they end.
SCALE_ITERATIONS, SCALE_RTOL = 20, 1e-6
# Log-loss of a residual that is infinite or NaN: more than any finite residual of a model that follows the data has.
LOSS_IF_NOT_FINITE = 1e3


@dataclass(frozen=True)
class Score:
    """Log-losses of held-out blocks, with the numbers that the price of a model depends on.

    Parameters
    ----------
    losses
        (B,) log-loss of each held-out block, summed over its samples.
    count
        N, number of recorded values in q.
    numbers
        k, number of parameters. The coefficient of a wave counts as the share (0 to 1) that the data determine.
    choices
        c, number of offers in the model.
    rms
        Of the residuals, in units of q over the balance.
    correlation_time
        τ, in samples.
    zeros
        Number of further parameters that are no choice among offers: zeros of sensors.
    fitted
        (B,) log-loss of each block for the fit to all samples; None if `losses` are of that fit, or of a free run.
    """

    losses: Tensor  # (B,)
    count: int
    numbers: float
    choices: int
    rms: float
    correlation_time: float = 1.0
    zeros: int = 0
    fitted: Tensor | None = None  # (B,)

    def replaces(self, simple: Score, offered: int) -> bool:
        """True if this richer model replaces a simpler model; `offered` is C, the number of offers."""
        return self.gain(simple, offered) > 0

    def gain(self, simple: Score, offered: int) -> float:
        """The smaller excess of the two sums over their bounds, with the τ of this richer model.

        The sums are over held-out blocks and, if both scores have these losses, of the fits to all samples.
        """
        dearer = self.price(self, offered) - self.price(simple, offered)
        total, error = _sum_and_error(simple.losses - self.losses)
        held_out = total - max(dearer + error / self.correlation_time**0.5, error)
        if self.fitted is None or simple.fitted is None:
            return held_out
        total, error = _sum_and_error(simple.fitted - self.fitted)
        return min(held_out, total - dearer / self.correlation_time - error)

    def clearly_better(self, simple: Score) -> bool:
        """True if the losses differ by more than their standard error, without which no τ lets a model replace one."""
        total, error = _sum_and_error(simple.losses - self.losses)
        return total > error

    def price(self, model: Score, offered: int) -> float:
        """Price of a model's parameters and choices at the τ of this score; `offered` is C, the number of offers."""
        chosen = math.log(math.comb(offered, model.choices))
        return (model.numbers + model.zeros) * self.price_of_a_number + self.correlation_time * chosen

    @property
    def price_of_a_number(self) -> float:
        """½ τ log (N/τ), the price of one parameter."""
        return self.correlation_time * math.log(self.count / self.correlation_time) / 2


def scores(
    model: HeldOut,
    sets: Sequence[Sequence[int]],
    choices: Sequence[int],
    count: int,
    floor: float,
    *,
    rough: bool = False,
) -> list[Score]:
    """Scores, to first order, of C models that keep these sets of a fit's parameters (indices).

    `choices` are the numbers of offers that the sets come from, `count` is N. Residuals below `floor`, in units of q
    over the balance, are rounding and count as `floor`. If `rough`, the scores are for `Score.clearly_better` alone:
    the fits to all samples are not computed.
    """
    block = torch.where(model.complete, model.block, -1)
    held_out = _of_misfits(model.residuals(sets), block, floor, white=True)
    fits = held_out if rough else _of_misfits(model.fitted_residuals(sets), block, floor)
    every = zip(held_out, fits, model.told(sets).sum(1).tolist(), choices, strict=True)
    return [
        Score(losses, count, numbers, chosen, error, time, fitted=fitted)
        for (losses, error, _), (fitted, _, time), numbers, chosen in every
    ]


def fitted_score(problem: ShootingProblem, path: Path, floor: float, zeros: int = 0) -> Score:
    """Score from the residuals of the fit itself, for two models that differ in few parameters.

    Residuals without a block would depend, to first order, more on the many shared parameters than on the few others.
    """
    block = torch.where(problem.data.complete, blocks(problem.data), -1)
    ((losses, rms, time),) = _of_misfits(problem.misfit(path)[None], block, floor)
    return Score(losses, int((problem.weight > 0).sum()), problem.P, 0, rms, time, zeros)


def free_run_score(problem: ShootingProblem, path: Path, numbers: float, floor: float) -> Score:
    """Score over the samples that a fit has not used, as a free run over whole trajectories predicts them.

    Choices cost nothing here: the few models that are compared in this way have already paid for their choices.
    """
    unseen = ~problem.used & problem.data.complete
    block = torch.where(unseen, torch.cumsum(unseen, 0) - 1, 0) * BLOCKS // max(1, int(unseen.sum()))
    ((losses, rms, time),) = _of_misfits(problem.misfit(path)[None], torch.where(unseen, block, -1), floor)
    return Score(losses, int(unseen.sum()) * problem.n, numbers, 0, rms, time)


def _of_misfits(r: Tensor, block: Tensor, floor: float, *, white: bool = False) -> list[tuple[Tensor, float, float]]:
    """Log-losses (B,), RMS and τ of each of C sets of residuals r (C, N, n) over the balance.

    `block` (N,) is the block of each sample; samples in block −1 do not count. |r| below `floor` counts as `floor`.
    τ of `white` residuals is 1 and is not computed.
    """
    inside = block >= 0
    r, block = r[:, inside], block[inside]
    scale = _scale(r).clamp_min(floor)
    x = r.abs().clamp_min(floor) / scale
    loss = scale.log() + (FREEDOM + 1) / 2 * torch.log1p(x.square() / FREEDOM)
    loss = loss.nan_to_num(nan=LOSS_IF_NOT_FINITE, posinf=LOSS_IF_NOT_FINITE).sum(2)
    losses = torch.zeros(len(r), int(block.max()) + 1, dtype=r.dtype, device=r.device).index_add_(1, block, loss)
    time = [1.0] * len(r) if white else correlation_time(r / scale).tolist()
    return list(zip(losses, r.square().mean((1, 2)).sqrt().tolist(), time, strict=True))


def _sum_and_error(by_block: Tensor) -> tuple[float, float]:
    """The sum over blocks (B,) and its standard error."""
    return float(by_block.sum()), float(by_block.std()) * len(by_block) ** 0.5


def are_white(problem: ShootingProblem, path: Path) -> bool:
    """True if the residuals of a fit are white: their correlation time τ exceeds 1 by chance alone.

    The sum Σ ρ_k = (τ − 1)/2 of m autocorrelations of white residuals has the variance m/N. Chance is what ½ log N,
    the price of a parameter, covers: N (Σ ρ_k)² / m ≤ log N.
    """
    r = problem.misfit(path)[problem.data.complete][None]
    total, lags = _correlated(r / _scale(r))
    return float(total.clamp_min(0.0).square() * r.numel()) <= float(lags) * math.log(r.numel())


def correlation_time(x: Tensor) -> Tensor:
    """Correlation time τ = 1 + 2 Σ ρ_k in samples, (C,), of residuals x (C, N, n) over their scale; 1 if white.

    ρ_k is the autocorrelation at lag k of the influence of a residual, the slope of its loss under Student's t. Lags
    are added in pairs until the first pair that is not positive (Geyer 1992).
    """
    return (1 + 2 * _correlated(x)[0]).clamp_min(1.0)


def _correlated(x: Tensor) -> tuple[Tensor, Tensor]:
    """Σ ρ_k over the lags k ≥ 1 that `correlation_time` adds, and the number of these lags, both (C,)."""
    influence = (x / (FREEDOM + x.square())).nan_to_num(nan=0.0, posinf=0.0, neginf=0.0)
    N = x.shape[1]
    power = torch.fft.rfft(influence, 2 * N, dim=1).abs().square().sum(2)
    covariance = torch.fft.irfft(power, 2 * N)[:, : N // 2 * 2]
    rho = covariance / covariance[:, :1].clamp_min(torch.finfo(x.dtype).tiny)
    pairs = rho.unflatten(1, (-1, 2)).sum(2)
    positive = (pairs > 0).cumprod(1)
    return (pairs * positive).sum(1) - 1, 2 * positive.sum(1) - 1


def _scale(r: Tensor) -> Tensor:
    """Maximum-likelihood scale of Student's t, (C, 1, n), of the residuals r (C, N, n) of each coordinate.

    Parameter-expanded EM (Liu, Rubin & Wu 1998), which needs far fewer iterations than EM.
    """
    squared, v = r.square(), FREEDOM
    tiny = torch.finfo(r.dtype).tiny
    s = squared.median(1, keepdim=True).values.clamp_min(tiny)
    # Σ w r² / Σ w with the weights w = 1 / (v + r²/s).
    for _ in range(SCALE_ITERATIONS):
        before = s
        s = (r.shape[1] / (squared + v * s).reciprocal_().sum(1, keepdim=True) - v * s).clamp_min(tiny)
        if bool(((s - before).abs() <= SCALE_RTOL * s).all()):
            break
    return s.sqrt()
