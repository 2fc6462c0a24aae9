"""Standard deviations and digits of the numbers of an equation, from the joint posterior of all parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.models import ContactLagrangian
from herglotz.training.equation_words import UNKNOWN, number
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.trades import Trade, combinations, joined

# Relative length. If the part of a number's derivative outside the span of others is shorter, it depends on the others.
DEPENDENT = 1e-9


@dataclass(frozen=True)
class Joint:
    """The posterior of a model's P numbers (`herglotz.training.laplace`).

    `alone` are standard deviations with all other unknowns fixed; `information` is the inverse covariance by the data
    without the prior, marginal over the start states.
    """

    covariance: Tensor  # (P, P)
    alone: Tensor  # (P,)
    information: Tensor  # (P, P)


class Numbers:
    """Value, deviation and conditional deviation of numbers that are functions of a model's parameters.

    With y = g·θ to first order the deviation of y is √(gᵀ C g). Rounding changes y alone, and the motion by no more
    than if one of its parameters took the change. The parameter with the largest effect on the motion sets the digits.
    """

    def __init__(self, model: ContactLagrangian, joint: Joint | None, digits: int = UNKNOWN):
        self.joint, self.digits, self.named = joint, digits, dict(model.named_parameters())
        self.at = {entry: k for k, entry in enumerate(ParameterVector(model).entries)}
        # Derivatives of every number, by its words.
        self.slopes: dict[str, dict[int, float]] = {}

    def known(self, value: Tensor, words: str) -> tuple[float, float | None, float | None]:
        """The value, its deviation, and the deviation that sets its digits; None if unknown.

        `words` name the number in `trades`; "": the number is no part of `trades`.
        """
        slopes, joint = self._slopes(value), self.joint
        if joint is None or not slopes:
            return float(value.detach()), None, None
        if words:
            self.slopes[words] = slopes
        at, g = torch.tensor(list(slopes)), joint.covariance.new_tensor(list(slopes.values()))
        deviation = math.sqrt(max(0.0, float(g @ joint.covariance[at][:, at] @ g)))
        by = g.abs() * joint.alone[at]
        # The derivative by a parameter that cancels, such as a common mass, is a rounding error.
        alone = float(by[by >= DEPENDENT * by.max()].min())
        finite = math.isfinite(deviation)
        return float(value.detach()), deviation if finite else None, alone if math.isfinite(alone) else None

    def _slopes(self, value: Tensor) -> dict[int, float]:
        """Derivatives of a number that are not 0, by the place of the parameter in the vector."""
        if not value.requires_grad or self.joint is None:
            return {}
        found = torch.autograd.grad(value, list(self.named.values()), allow_unused=True, retain_graph=True)
        slopes = {}
        for name, slope in zip(self.named, found, strict=True):
            rows = () if slope is None else slope.reshape(-1).tolist()
            slopes |= {self.at[name, i]: x for i, x in enumerate(rows) if x and (name, i) in self.at}
        return slopes

    def shown(self, value: Tensor, words: str, bracketed: bool = False) -> str:
        """The text of a number inside a term, with its deviation in brackets or without."""
        x, deviation, alone = self.known(value, words)
        return ("−" if x < 0 else "") + number(abs(x), deviation if bracketed else None, alone, self.digits)

    def trades(self) -> list[Trade]:
        """Combinations of the printed numbers that the data do not determine; overlapping ones are joined.

        A combination of parameters that leaves every printed number unchanged, two rates in one number, is none.
        """
        if self.joint is None or not self.slopes:
            return []
        M = self.joint.information
        # Parameters over `size`, and numbers over the length of `row`, have no unit.
        size = torch.where(M.diagonal() > 0, M.diagonal(), 1.0).sqrt()
        rows, names, basis = [], [], M.new_zeros(0, len(M))
        for words, slopes in self.slopes.items():
            row = M.new_zeros(len(M))
            row[list(slopes)] = row.new_tensor(list(slopes.values()))
            row = row / size
            row = new = row / row.norm()
            # Gram–Schmidt twice, against rounding.
            for _ in range(2):
                new = new - basis.T @ (basis @ new)
            if float(new.norm()) > DEPENDENT:
                rows, names, basis = [*rows, row], [*names, words], torch.cat([basis, (new / new.norm())[None]])
        back = torch.linalg.pinv(torch.stack(rows))  # (P, K)
        B = back.T @ (M / size[:, None] / size) @ back
        return joined(combinations(B, B.diagonal(), names))
