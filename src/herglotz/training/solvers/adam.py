"""Adam and AdamW with a cosine schedule, on all rows or on minibatches: for comparison, and for large networks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from herglotz.training.solvers.levenberg_marquardt import OptimiserResult, Progress

# Decay of AdamW's weights (Loshchilov & Hutter 2019).
DECAY = 1e-2
# The search ends after so many costs in a row that differ by less than this, relative.
QUIET, PATIENCE = 1e-8, 50


def adam(
    problem: Any,
    x: Tensor,  # (P,) start
    *,
    max_iterations: int = 2000,
    learning_rate: float = 3e-3,
    decay: float = 0.0,
    batch: int | None = None,
    seed: int = 0,
    callback: Progress | None = None,
) -> OptimiserResult:
    """Adam with a cosine schedule over `max_iterations`; returns the best finite point visited.

    `problem` is a sum over `rows`, with `cost(x)` and `cost_and_gradient(x, rows)`, as `OneStep`. `decay` of the
    weights makes Adam AdamW. A step takes `batch` rows (None: all), each row once a round, in an order drawn by `seed`;
    the cost of all rows is taken, and the best point chosen by this cost, once a round. The search ends earlier where
    the cost has stopped to change. `callback` is called after each iteration; a search goes on from what it holds, bit
    for bit.
    """
    current = x.clone().requires_grad_()
    optimiser = torch.optim.AdamW([current], lr=learning_rate, weight_decay=decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max_iterations)
    best, best_x, history, reason = float("inf"), x, [], "max_iterations"
    last, quiet, iteration = float("nan"), 0, 0
    rounds = _rounds(problem.rows, batch, seed)
    resumed = None if callback is None else callback.resumed
    if resumed is not None:
        iteration, best, best_x = resumed["iteration"], resumed["best"], resumed["best_x"].to(x)
        history, last, quiet = list(resumed["history"]), resumed["last"], resumed["quiet"]
        with torch.no_grad():
            current.copy_(resumed["current"])
        current.grad = torch.zeros_like(x)
        optimiser.load_state_dict(resumed["optimiser"])
        schedule.load_state_dict(resumed["schedule"])
        for _ in range(iteration):
            next(rounds)

    def search() -> dict[str, Any]:
        return {
            "iteration": iteration, "best": best, "best_x": best_x, "history": history, "last": last, "quiet": quiet,
            "current": current.detach(), "optimiser": optimiser.state_dict(), "schedule": schedule.state_dict(),
        }  # fmt: skip

    while iteration < max_iterations and quiet < PATIENCE:
        iteration += 1
        rows, last_of_round = next(rounds)
        here = current.detach()
        cost, gradient = problem.cost_and_gradient(here, rows)
        if rows is not None and (last_of_round or iteration in (1, max_iterations)):
            cost, last_of_round = problem.cost(here), True
        if not bool(torch.isfinite(cost + gradient.sum())):
            reason = "not_finite"
            break
        if last_of_round:
            if float(cost) < best:
                best, best_x = float(cost), here.clone()
                history.append(best)
            quiet = quiet + 1 if abs(float(cost) - last) <= QUIET * abs(last) else 0
            last = float(cost)
        current.grad = gradient
        optimiser.step()
        schedule.step()
        if callback is not None:
            callback(iteration, best, best_x, search)
    return OptimiserResult(best_x, best, "converged" if quiet >= PATIENCE else reason, iteration, history)


def _rounds(count: int, batch: int | None, seed: int) -> Iterator[tuple[Tensor | None, bool]]:
    """Batches of rows (None: all rows), and whether a batch is the last of its round; the same on every machine."""
    make = torch.Generator().manual_seed(seed)
    while batch is None or batch >= count:
        yield None, True
    while True:
        batches = torch.randperm(count, generator=make).split(batch)
        for i, rows in enumerate(batches):
            yield rows, i == len(batches) - 1
