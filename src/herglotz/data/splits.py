"""Training and test parts of a set of trajectories, as rows of their concatenation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from herglotz.data.checks import MIN_SAMPLES, check_fraction, offsets_of
from herglotz.errors import InputError

RUN = 200  # samples in a row of a part of a trajectory, at least
Part = tuple[Tensor, tuple[int, ...]]  # rows of the concatenation, and how many of each trajectory


def time_split(
    lengths: Sequence[int],  # samples of each trajectory
    fraction: float,  # of every trajectory that trains
    source: str = "",
) -> tuple[Part, Part]:
    """Cut each trajectory after its first `round(fraction * length)` samples.

    Raises
    ------
    InputError
        If the fraction is not inside (0, 1), or a part of any trajectory would have fewer than three samples.
    """
    check_fraction(fraction)
    train, test = [], []
    cuts = tuple(round(fraction * length) for length in lengths)
    rest = tuple(length - cut for cut, length in zip(cuts, lengths, strict=True))
    start = 0
    for b, (cut, left) in enumerate(zip(cuts, rest, strict=True)):
        if min(cut, left) < MIN_SAMPLES:
            raise InputError(
                f"{source or 'trajectories'}: fraction {fraction:g} cuts the {cut + left} samples of trajectory {b} "
                f"into {cut} and {left}, each part needs {MIN_SAMPLES}; record more, change the fraction, or leave the "
                "trajectory out"
            )
        train.append(torch.arange(start, start + cut))
        test.append(torch.arange(start + cut, start + cut + left))
        start += cut + left
    return (torch.cat(train), cuts), (torch.cat(test), rest)


class Concatenation(Protocol):
    """Trajectories stored one after the other."""

    @property
    def t(self) -> Tensor:
        """Time, (N,)."""
        ...

    @property
    def lengths(self) -> tuple[int, ...]:
        """Samples of each trajectory."""
        ...


def leading_rows(data: Concatenation, lengths: Sequence[int]) -> Tensor:
    """Rows of the first `lengths[b]` samples of every trajectory b."""
    spans = [torch.arange(first, first + k) for first, k in zip(offsets_of(data.lengths), lengths, strict=True)]
    return torch.cat(spans).to(data.t.device)


def liveliest_rows(q: Tensor, lengths: Sequence[int], most: int) -> Part:
    """At most about `most` samples: of trajectories evenly chosen the run of samples that moves most."""
    own = min(max(most // len(lengths), RUN), max(lengths))
    every = max(1, -(-own * len(lengths) // most))
    rows, kept = [], []
    size = q.std(0, correction=0).clamp_min(torch.finfo(q.dtype).tiny)
    for first, length in list(zip(offsets_of(lengths), lengths, strict=True))[::every]:
        count = min(own, length)
        moved = (q[first : first + length].diff(dim=0) / size).square().sum(1).cumsum(0)
        gone = torch.cat([moved.new_zeros(1), moved])
        start = first + int((gone[count - 1 :] - gone[: length - count + 1]).argmax())
        rows.append(torch.arange(start, start + count))
        kept.append(count)
    return torch.cat(rows), tuple(kept)
