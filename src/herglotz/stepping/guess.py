"""The start of the Newton iteration in a rollout: the polynomial through the last positions, extrapolated."""

from __future__ import annotations

from math import comb

import torch
from torch import Tensor

# Number of positions: six take a third fewer evaluations than four (a cubic) at small h, and no more at large h.
LENGTH = 6
# Weights of polynomials through 1 … LENGTH equally spaced positions: binomials with alternating signs.
EQUAL = {n: tuple((-1.0) ** (n - 1 - i) * comb(n, i) for i in range(n)) for n in range(1, LENGTH + 1)}


def extrapolation_weights(h: Tensor, count: int) -> Tensor:
    """Lagrange weights (..., count) of `count` positions for the next position; h (..., count) are the steps."""
    t = torch.cat([torch.zeros_like(h[..., :1]), h.cumsum(-1)], -1)
    t, target = t[..., :-1] - t[..., -2:-1], h[..., -1]
    weights = []
    for i in range(count):
        weight = torch.ones_like(target)
        for j in range(count):
            if j != i:
                weight = weight * (target - t[..., j]) / (t[..., i] - t[..., j])
        weights.append(weight)
    return torch.stack(weights, -1)


class Extrapolation:
    """The guesses of a rollout; the weights of equal steps are constants, other weights are computed once."""

    def __init__(self, h: Tensor):
        # A scalar h, expanded.
        self.equal = h.stride(-1) == 0 or h.shape[-1] == 1
        self.h = h.detach()
        self._weights: dict[int, Tensor] = {}

    def __call__(self, trail: tuple[Tensor, ...], k: int) -> Tensor:
        """The guess for the end of step k from the positions (..., n) that led to its start, at most `LENGTH`."""
        count = len(trail)
        if self.equal:
            weights = EQUAL[count]
            guess = weights[-1] * trail[-1]
            for weight, q in zip(weights[:-1], trail, strict=False):
                guess = torch.add(guess, q, alpha=weight)
            return guess
        if count not in self._weights:
            self._weights[count] = extrapolation_weights(self.h.unfold(-1, count, 1), count)
        weights = self._weights[count][..., k - count + 1, :]
        return (torch.stack(trail, -1) * weights[..., None, :]).sum(-1)
