"""What the quadratic model of a fit says of offers: those that may join, those that may leave, and exchanges."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from herglotz.training.offers import Offer
from herglotz.training.pruning import inverse_of
from herglotz.training.trials import Trial

UNSEEN = 1e-9  # of an offer's own curvature: what other numbers leave less of cannot be told from them


def gains(trial: Trial) -> list[tuple[float, Offer]]:
    """By how much each offer that is not taken lowers the cost by the quadratic model, in units of the misfit."""
    left, found = [offer for offer in trial.fitter.offers if offer.name not in trial.taken], trial.everything
    if found is None:
        return []
    H, g, at = found
    free = torch.tensor([at[name] for name in trial.problem.parameters.numbers])
    own = (torch.tensor([at[name] for name in offer.numbers]) for offer in left)
    return [(_gain(H, g, free, i), offer) for i, offer in zip(own, left, strict=True)]


def swaps(trial: Trial) -> Iterator[tuple[float, str, str]]:
    """By how much a new offer lowers the cost in the place of an old one by the quadratic model, at the best."""
    numbers, found = trial.problem.parameters.numbers, trial.everything
    if found is None:
        return
    H, g, at = found
    taken = [offer for offer in trial.fitter.offers if offer.name in trial.taken and len(offer.amplitudes) == 1]
    old = {at[offer.amplitudes[0]]: offer.name for offer in taken}
    for offer in trial.fitter.offers:
        own = [at[name] for name in offer.numbers]
        if offer.name in trial.taken or not old:
            continue
        free = torch.tensor([*(at[name] for name in numbers), *own])
        C = inverse_of(H[free][:, free])
        values = g.new_tensor([*(trial.values[name] for name in numbers), *(0.0 for _ in own)])
        x = values - C @ g[free]
        cost = x.square() / C.diagonal() / 2
        places = [k for k, i in enumerate(free.tolist()) if i in old]
        k = min(places, key=lambda k: float(cost[k]))
        yield float(g[free] @ C @ g[free]) / 2 - float(cost[k]), offer.name, old[int(free[k])]


def order_of(trial: Trial) -> tuple[list[str], int]:
    """The offers that are taken as they leave one after the other, the one that costs least first; how many had best.

    Those had best leave without which twice the cost and the worth of the numbers that stay are least.
    """
    numbers = trial.problem.parameters.numbers
    found = trial.curvature(numbers)
    if found is None:
        return [], 0
    H, x = found[0], trial.theta.clone()
    keep, order, total = list(range(len(numbers))), [], [0.0]
    left = [offer for offer in trial.fitter.offers if offer.name in trial.taken]
    while left:
        C, theta, costs = inverse_of(H[keep][:, keep]), x[keep], []
        for offer in left:  # what the others miss without it, less what its numbers are worth, and how they move
            own = [keep.index(numbers.index(name)) for name in offer.amplitudes]
            by = torch.linalg.lstsq(C[own][:, own], theta[own, None]).solution[:, 0]
            costs.append((float(theta[own] @ by) - worth(trial, offer), C[:, own] @ by))
        k = min(range(len(left)), key=lambda k: costs[k][0])
        x[keep] = theta - costs[k][1]
        order.append(left[k].name)
        total.append(total[-1] + costs[k][0])
        out = {numbers.index(name) for name in left.pop(k).numbers}
        keep = [j for j in keep if j not in out]
    return order, total.index(min(total))


def worth(trial: Trial, offer: Offer) -> float:
    """Twice what the numbers of an offer have to lower the cost by at least."""
    return math.log(trial.score.count) * len(offer.numbers)


def _gain(H: Tensor, g: Tensor, free: Tensor, own: Tensor) -> float:
    """By how much numbers `own` lower the cost by the quadratic model, the free ones following."""
    size = torch.where(H.diagonal() > 0, H.diagonal(), 1.0).sqrt()
    A, b = H / size[:, None] / size, g / size
    C = torch.linalg.pinv(A[free][:, free], hermitian=True) @ torch.cat([A[free][:, own], b[free, None]], 1)
    S = A[own][:, own] - A[free][:, own].T @ C[:, :-1]
    slope = b[own] - A[free][:, own].T @ C[:, -1]
    values, vectors = torch.linalg.eigh(S)
    along = vectors.T @ slope
    return float(torch.where(values > UNSEEN, along.square() / values.clamp_min(1e-300), 0.0).sum()) / 2
