"""Combinations of numbers that data do not determine: eigenvectors of the information with small eigenvalues.

Scaled to a unit diagonal the information has no units. A combination with a small eigenvalue λ moves the prediction
√(λ_max/λ) times less than the best determined combination does: the condition index of Belsley, Kuh & Welsch (1980),
who call 30 harmful. The eigenvector says which numbers are traded. Eigenvectors of equal eigenvalues, as those of exact
null directions, may be any basis of their span; sparse vectors then describe the span (`sparse_basis`).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

# Condition index above which parameters are not determined one by one (Belsley, Kuh & Welsch 1980).
HARMFUL = 30.0
# Condition index of an exact null direction, up to rounding.
LARGEST = 1e7
# A parameter with a smaller share of a combination is not named.
PART = 0.05
# Eigenvalues of the scaled information closer than this (of the largest) count as equal. Rounding moves eigenvalues by
# some 1e-15, which turns eigenvectors across a gap g by 1e-15/g: names stay below PART by a margin of 1e4.
EQUAL = 1e-10
# Pivots above this share of the largest are ties, of which the first is taken: rounding must not choose.
NEAR_LARGEST = 0.9
# An entry of a parameter: columns of a table, in terms such as x effort[0], may have numbers in brackets, too.
ENTRY = re.compile(r"(\w+(?:\.\w+)+)\[(\d+)\]")
WORDS = {
    "kinetic.log_diagonal": "the mass",
    "kinetic.off_diagonal": "the coupling of masses",
    "potential.stiffness": "the stiffness at q = 0",
    "potential.tilt": "the constant force at q = 0, towards smaller q",
    "damping.rate": "the damping rate γ",
    "damping.drag": "the drag",
    "friction.viscous": "viscous friction",
    "friction.coulomb": "dry friction",
    "friction.breakaway": "the excess of dry friction at breakaway",
    "friction.log_smooth": "the speed below which dry friction is smooth",
    "friction.log_stribeck": "the speed over which breakaway fades",
    "friction.input_map": "the map from inputs to forces",
    "friction.input_zero": "the zero of the input's sensor",
}


@dataclass(frozen=True)
class Trade:
    """Parameters of which the data determine some combination, and not each one alone.

    The condition `index` says how many times less the combination moves the prediction than the best determined
    combination does. `parts` are parameters and their shares of the combination, the largest first.
    """

    index: float
    parts: tuple[tuple[str, float], ...]

    def __str__(self) -> str:
        names = [in_words(name) for name, _ in self.parts]
        if len(names) == 1:
            return f"{names[0]} has next to no effect on these data: its value is the prior's, not a measurement"
        listed = ", ".join(names[:-1]) + " and " + names[-1]
        how = "cannot be told apart at all" if self.index >= LARGEST else f"are hard to tell apart ({self.index:.0f}:1)"
        return f"{listed} {how}: change one, the others make up for it, and the prediction stays the same"


def joined(trades: Sequence[Trade]) -> list[Trade]:
    """The trades, those that share a parameter joined to one trade with the larger index."""
    found: list[Trade] = []
    for trade in trades:
        parts, apart = {name for name, _ in trade.parts}, []
        for other in found:
            known = {name for name, _ in other.parts}
            if parts & known:
                more = tuple(part for part in trade.parts if part[0] not in known)
                trade = Trade(max(trade.index, other.index), (*other.parts, *more))
                parts |= known
            else:
                apart.append(other)
        found = [*apart, trade]
    return found


def in_words(name: str, which: str = ", entry {}") -> str:
    """A parameter's name, `friction.viscous[1]`, as a newcomer may read it."""
    entry = ENTRY.fullmatch(name)
    return WORDS.get(entry[1], entry[1]) + which.format(int(entry[2]) + 1) if entry else WORDS.get(name, name)


def listed(names: Sequence[str]) -> str:
    """Names of parameters and of terms in words, one after the other."""
    return ", ".join(in_words(name, " ({})") for name in names)


def combinations(M: Tensor, alone: Tensor, names: Sequence[str]) -> list[Trade]:
    """The combinations of numbers with the information M (K, K) that are not determined, the worst first.

    `alone` (K,) is the information on each number, prior included, if all other numbers were known.
    """
    # A parameter of no effect has a diagonal of rounding size, of either sign.
    seen = M.diagonal() > alone / LARGEST**2
    found = [Trade(LARGEST, ((name, 1.0),)) for name, is_seen in zip(names, seen.tolist(), strict=True) if not is_seen]
    kept, M = [name for name, is_seen in zip(names, seen.tolist(), strict=True) if is_seen], M[seen][:, seen]
    if not kept:
        return found
    size = M.diagonal().sqrt()
    M = M / size[:, None] / size
    values, vectors = torch.linalg.eigh(M)
    # Eigenvalues ascend.
    for vector in _within_equal(values, vectors).T:
        value = vector @ M @ vector
        condition = float((values[-1] / value.clamp_min(values[-1] / LARGEST**2)).sqrt())
        if condition < HARMFUL:
            break
        share = vector.square()
        order = [k for k in share.argsort(descending=True).tolist() if share[k] >= PART]
        found.append(Trade(condition, tuple((kept[k], float(share[k])) for k in order)))
    return found


def _within_equal(values: Tensor, vectors: Tensor) -> Tensor:
    """The eigenvectors, those of equal eigenvalues replaced by a sparse basis of their span; values ascend."""
    groups = vectors.tensor_split((values.diff() > EQUAL * values[-1]).nonzero()[:, 0] + 1, 1)
    return torch.cat([group if group.shape[1] == 1 else sparse_basis(group) for group in groups], 1)


def sparse_basis(span: Tensor) -> Tensor:
    """A basis of the same span, (m, k), in reduced echelon form, columns of length 1: few entries differ from 0.

    Where the span has a basis of vectors that share no entry, this is that basis.
    """
    basis = span.clone()
    for j in range(basis.shape[1]):
        size = basis[:, j:].norm(dim=1)
        row = int((size >= NEAR_LARGEST * size.max()).nonzero()[0])
        column = j + int(basis[row, j:].abs().argmax())
        basis[:, [j, column]] = basis[:, [column, j]]
        basis[:, j] /= basis[row, j].clone()
        others = torch.arange(basis.shape[1]) != j
        basis[:, others] -= basis[:, j : j + 1] * basis[row, others]
    return basis / basis.norm(dim=0)
