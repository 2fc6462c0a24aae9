"""The one comparison of a fit: what a model misses held-out blocks of time by, and whether a richer one is worth it.

A richer model of k_r numbers, which come in c_r of C offers, replaces a simpler one where

    Σ_b (ℓ_b(simple) − ℓ_b(rich)) > ½ (k_r − k_s) log N + log C(C, c_r) − log C(C, c_s) + the standard error,

ℓ_b being the log-loss of block b by Student's t, had its samples been left out of the fit. Of white residuals this is
the extended Bayesian information criterion (Chen & Chen 2008). Where residuals are no noise, blocks differ, the
standard error grows, and it decides. Lost blocks and outliers weigh little: the loss of Student's t grows as log |r|.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.training.problems.robust import FREEDOM
from herglotz.training.problems.shooting import ShootingProblem
from herglotz.training.solvers.lifted_newton import Path

BLOCKS = 10  # of time, at least, over all trajectories
STAY = 20  # first samples of a trajectory, and a tenth of it at most, that are never left out: they tell its start
ROUNDS = 30  # of the scale of Student's t
WORST = 1e3  # the loss of a residual that is no number
RIDGE = 1e-12  # of the largest: what is added to the curvature by starts, which few samples may not tell


@dataclass(frozen=True)
class Score:
    """Log-losses of held-out blocks, and what decides beside them."""

    losses: Tensor  # (B,) sums over the samples of a block
    count: int  # N, numbers in q
    numbers: float  # k of the model: of those with a prior what the data tell
    choices: int  # c, how many offers it has taken
    rms: float  # of held-out residuals, in units of q over the balance
    zeros: int = 0  # further numbers, which are one choice for all: zeros of sensors

    def replaces(self, simple: Score, offered: int) -> bool:
        """Whether this richer model replaces a simpler one, where there are so many offers."""
        return self.gain(simple, offered) > 0

    def gain(self, simple: Score, offered: int) -> float:
        """The left side of the inequality less the right one."""
        by_block = simple.losses - self.losses
        error = float(by_block.std()) * len(by_block) ** 0.5
        return float(by_block.sum()) - self.price(offered) + simple.price(offered) - error

    def price(self, offered: int) -> float:
        """½ k log N + log (C over c)."""
        chosen = math.log(math.comb(offered, self.choices))
        return (self.numbers + self.zeros) * math.log(self.count) / 2 + chosen


def score(
    problem: ShootingProblem, path: Path, theta: Tensor, numbers: float, choices: int, floor: float
) -> Score:
    """The score of a fit; misfits below `floor`, in units of q over the balance, are rounding."""
    block = blocks(problem.data).to(theta.device)
    r = held_out_residuals(problem, path, theta, block)
    return _of_residuals(r, block, floor, count=problem.data.q.numel(), numbers=numbers, choices=choices)


def free_run_score(problem: ShootingProblem, path: Path, numbers: float, choices: int, floor: float) -> Score:
    """The score over the samples that a fit has not used, which a free run over whole trajectories foretells."""
    unseen = ~problem.used
    block = torch.where(unseen, torch.cumsum(unseen, 0) - 1, 0) * BLOCKS // max(1, int(unseen.sum()))
    block = torch.where(unseen, block, -1)
    count = int(unseen.sum()) * problem.n
    return _of_residuals(problem.misfit(path), block, floor, count=count, numbers=numbers, choices=choices)


def _of_residuals(r: Tensor, block: Tensor, floor: float, **model: Any) -> Score:
    """Of residuals (N, n) over the balance in blocks (N,); −1: in none."""
    inside = block >= 0
    losses = torch.zeros(int(block.max()) + 1, dtype=r.dtype, device=r.device)
    for own in r.T:
        scale = max(_scale(own[inside]), floor)
        loss = math.log(scale) + (FREEDOM + 1) / 2 * torch.log1p((own / scale).square() / FREEDOM)
        losses.index_add_(0, block[inside], loss[inside].nan_to_num(nan=WORST, posinf=WORST))
    return Score(losses, rms=float(r[inside].square().mean().sqrt()), **model)


def blocks(data: Trajectories) -> Tensor:
    """The block of time of every sample, (N,); −1: it stays. Every trajectory has two at least."""
    each, parts, first = max(2, -(-BLOCKS // len(data))), [], 0
    for length in data.lengths:
        part = torch.arange(length) * each // length + first
        part[: min(STAY, length // 10)] = -1
        parts.append(part)
        first += each
    return torch.cat(parts)


def _scale(r: Tensor) -> float:
    """Scale of Student's t at which r is likeliest."""
    squared, v = r.square(), FREEDOM
    s = squared.median().clamp_min(torch.finfo(r.dtype).tiny)
    for _ in range(ROUNDS):
        s = ((v + 1) * squared / (v + squared / s)).mean().clamp_min(torch.finfo(r.dtype).tiny)
    return float(s.sqrt())


def held_out_residuals(problem: ShootingProblem, path: Path, theta: Tensor, block: Tensor) -> Tensor:
    """Residuals (N, n) over the balance that every sample would have if its block had been left out, to first order.

    The start of a segment is told by its other samples or, where all of them are left out, by its own. What joints say
    of parameters is left out.
    """
    grid, P = problem.grid, problem.P
    r = problem.misfit(path) / problem.sigma
    by = (problem.weight * problem.root_weights(problem.weight * r))[..., None]
    plain = problem.slopes_at_samples(theta, path) / problem.deviations[:, None]
    rows = torch.cat([plain, r[..., None]], -1)  # (N, n, P + d + 1)
    segment = grid.node // (grid.h.shape[1] + 1)
    piece, of = torch.unique_consecutive(torch.stack([segment, block], 1), dim=0, return_inverse=True)
    grams = _grams(rows * by, of, len(piece))  # (Q, P + d + 1, P + d + 1)
    S, B = grid.segments, int(block.max()) + 1
    whole = grams.new_zeros(S, *grams.shape[1:]).index_add_(0, piece[:, 0], grams)
    total, right = _reduced(whole, P)
    _, A, b = problem.prior_equations(theta)
    total, right = total.sum(0) + A, right.sum(0) + b
    out = r.clone()
    for k in range(B):
        mine = (piece[:, 1] == k).nonzero()[:, 0]
        s, own = piece[mine, 0], grams[mine]
        kept = whole[s] - own
        gone = torch.isin(s, piece[piece[:, 1] != k, 0], invert=True)  # nothing of the segment is left
        left, slope = _reduced(kept, P)
        was, its = _reduced(whole[s], P)
        left, slope = (torch.where(gone.reshape(-1, *[1] * (x.dim() - 1)), 0.0, x) for x in (left, slope))
        H, g = total - was.sum(0) + left.sum(0), right - its.sum(0) + slope.sum(0)
        step = -_solved(H, g)
        source = torch.where(gone[:, None, None], own, kept)
        T, C, c = source[:, P:-1, P:-1], source[:, P:-1, :P], source[:, P:-1, -1]
        by_state = -torch.linalg.solve(_ridged(T), (c + C @ step)[..., None])[..., 0]
        at = (block == k).nonzero()[:, 0]
        place = torch.full((len(piece),), -1, device=r.device)
        place[mine] = torch.arange(len(mine), device=r.device)
        moved = by_state[place[of[at]]]
        out[at] = r[at] + plain[at][..., :P] @ step + (plain[at][..., P:] * moved[:, None]).sum(-1)
    return out * problem.sigma


def _grams(rows: Tensor, of: Tensor, count: int) -> Tensor:
    """Σ row rowᵀ of each piece, (Q, w, w): pieces are runs of samples."""
    counts = torch.bincount(of, minlength=count).tolist()
    parts = [part.flatten(0, 1) for part in rows.split(counts)]
    return torch.stack([part.T @ part for part in parts])


def _reduced(grams: Tensor, P: int) -> tuple[Tensor, Tensor]:
    """(C − Bᵀ T⁻¹ B, b_θ − Bᵀ T⁻¹ b_x) of each segment alone, its start being eliminated."""
    T, B = _ridged(grams[:, P:-1, P:-1]), grams[:, P:-1, :P]
    solved = torch.linalg.solve(T, torch.cat([B, grams[:, P:-1, -1:]], -1))
    return grams[:, :P, :P] - B.mT @ solved[..., :P], grams[:, :P, -1] - (B.mT @ solved[..., -1:])[..., 0]


def _ridged(T: Tensor) -> Tensor:
    size = T.diagonal(dim1=-2, dim2=-1)
    return T + torch.diag_embed(RIDGE * size + torch.finfo(T.dtype).tiny ** 0.5)


def _solved(H: Tensor, g: Tensor) -> Tensor:
    """H⁺ g, scaled to a unit diagonal."""
    if not len(g):
        return g
    size = torch.where(H.diagonal() > 0, H.diagonal(), 1.0).sqrt()
    scaled = H / size[:, None] / size
    if not bool(torch.isfinite(scaled).all()):
        return torch.full_like(g, torch.nan)  # the block counts as lost
    return torch.linalg.pinv(scaled, hermitian=True, rtol=RIDGE) @ (g / size) / size
