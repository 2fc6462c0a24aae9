"""How the numbers of an equation are rounded: by what the data say of all of them together."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from herglotz.models import ContactLagrangian
from herglotz.training.equation_words import UNKNOWN, number
from herglotz.training.parameter_vector import ParameterVector
from herglotz.training.trades import Trade, combinations, joined

DEPENDENT = 1e-9  # of its length: a number that differs by less from a combination of others is one of them


@dataclass(frozen=True)
class Joint:
    """What the data say of a model's P numbers together (`herglotz.training.laplace`)."""

    covariance: Tensor  # (P, P)
    alone: Tensor  # (P,) standard deviation of each with all other unknowns held
    information: Tensor  # (P, P) what the data alone say of them, whatever the start states are


class Numbers:
    """What is known of tensors that a model's parameters make: value, deviation, and deviation with all others held.

    With y = g·θ to first order the deviation of y is √(gᵀ C g). Rounding changes y alone, and the motion by no more
    than if one of its parameters took the change: it is rounded as that of them asks which the motion depends on most.
    """

    def __init__(self, model: ContactLagrangian, joint: Joint | None, digits: int = UNKNOWN):
        self.joint, self.digits, self.named = joint, digits, dict(model.named_parameters())
        self.at = {entry: k for k, entry in enumerate(ParameterVector(model).entries)}
        self.told: dict[str, dict[int, float]] = {}  # the slopes of every number, by the words for it

    def known(self, value: Tensor, words: str) -> tuple[float, float | None, float | None]:
        """The value, its deviation, and the one that it is rounded by; None where nothing tells them.

        `words` are what the number is called where it is not determined; "": that is not told.
        """
        slopes, joint = self._slopes(value), self.joint
        if joint is None or not slopes:
            return float(value.detach()), None, None
        if words:
            self.told[words] = slopes
        at, g = torch.tensor(list(slopes)), joint.covariance.new_tensor(list(slopes.values()))
        deviation = math.sqrt(max(0.0, float(g @ joint.covariance[at][:, at] @ g)))
        by = g.abs() * joint.alone[at]
        alone = float(by[by >= DEPENDENT * by.max()].min())  # a mass that cancels leaves rounding
        finite = math.isfinite(deviation)
        return float(value.detach()), deviation if finite else None, alone if math.isfinite(alone) else None

    def _slopes(self, value: Tensor) -> dict[int, float]:
        """The derivatives of a number by the parameters that it is made of, by their places among the fitted ones."""
        if not value.requires_grad or self.joint is None:
            return {}
        found = torch.autograd.grad(value, list(self.named.values()), allow_unused=True, retain_graph=True)
        slopes = {}
        for name, slope in zip(self.named, found, strict=True):
            rows = () if slope is None else slope.reshape(-1).tolist()
            slopes |= {self.at[name, i]: x for i, x in enumerate(rows) if x and (name, i) in self.at}
        return slopes

    def shown(self, value: Tensor, words: str, bracketed: bool = False) -> str:
        """A number beside those in front of terms, with its deviation in brackets or without one."""
        x, deviation, alone = self.known(value, words)
        return ("−" if x < 0 else "") + number(abs(x), deviation if bracketed else None, alone, self.digits)

    def trades(self) -> list[Trade]:
        """The combinations of the numbers that were told which the data do not determine, those that overlap as one.

        A combination of parameters that leaves all of them as they are, two rates in one number, is none.
        """
        if self.joint is None or not self.told:
            return []
        M = self.joint.information
        size = torch.where(M.diagonal() > 0, M.diagonal(), 1.0).sqrt()  # parameters over it have no unit
        rows, names, basis = [], [], M.new_zeros(0, len(M))
        for words, slopes in self.told.items():
            row = M.new_zeros(len(M))
            row[list(slopes)] = row.new_tensor(list(slopes.values()))
            row = row / size
            row = row / row.norm()  # numbers over their size in `row` have no unit either
            new = row
            for _ in range(2):  # rounding of the first time goes
                new = new - basis.T @ (basis @ new)
            if float(new.norm()) > DEPENDENT:
                rows, names, basis = [*rows, row], [*names, words], torch.cat([basis, (new / new.norm())[None]])
        back = torch.linalg.pinv(torch.stack(rows))  # (P, K)
        B = back.T @ (M / size[:, None] / size) @ back
        return joined(combinations(B, B.diagonal(), names))
