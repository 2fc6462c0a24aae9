"""Where the Newton iteration of a rollout starts: the polynomial through the last positions, continued."""

from __future__ import annotations

import torch
from torch import Tensor

LENGTH = 6  # positions used: against a cubic, a third fewer evaluations at small h and no more at large h
# Weights of polynomials through equally spaced positions: binomials with alternating signs.
EQUAL = {
    1: (1.0,),
    2: (-1.0, 2.0),
    3: (1.0, -3.0, 3.0),
    4: (-1.0, 4.0, -6.0, 4.0),
    5: (1.0, -5.0, 10.0, -10.0, 5.0),
    6: (-1.0, 6.0, -15.0, 20.0, -15.0, 6.0),
}


def extrapolation_weights(h: Tensor, count: int) -> Tensor:
    """Lagrange weights (..., count) of as many positions for the next; h (..., count): steps between and after."""
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
    """The guesses of one rollout; the weights are constants for equal steps and made once, all of them, for others."""

    def __init__(self, h: Tensor):
        self.equal = h.stride(-1) == 0 or h.shape[-1] == 1  # a scalar h, expanded
        self.h = h.detach()
        self._weights: dict[int, Tensor] = {}

    def __call__(self, trail: tuple[Tensor, ...], k: int) -> Tensor:
        """The guess for the end of step k from the positions (..., n) that led to its start, at most `LENGTH`."""
        count = len(trail)
        if count == 1:
            return trail[-1]
        if self.equal:
            weights = EQUAL[count]
            guess = weights[-1] * trail[-1]
            for weight, q in zip(weights[:-1], trail, strict=False):
                guess = torch.add(guess, q, alpha=weight)
            return guess
        weights = self._at(count)[..., k - count + 1, :]
        return (torch.stack(trail, -1) * weights[..., None, :]).sum(-1)

    def _at(self, count: int) -> Tensor:
        if count not in self._weights:
            self._weights[count] = extrapolation_weights(self.h.unfold(-1, count, 1), count)
        return self._weights[count]
