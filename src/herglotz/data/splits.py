"""Parts of a set of trajectories, as rows of their concatenation: training and test, and every m-th sample."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from herglotz.data.checks import MIN_SAMPLES, offsets_of
from herglotz.errors import InputError, check_whole

# `liveliest_rows` takes at least this many samples in a row of a trajectory.
MIN_ROW = 200
# This many samples in a row show their noise: polynomials in time are fitted to as many (`herglotz.data.noise`).
MIN_SHOWING_NOISE = 9
# A part is rows of the concatenation, and the number of rows of each trajectory.
Part = tuple[Tensor, tuple[int, ...]]


def time_split(lengths: Sequence[int], fraction: float, source: str = "") -> tuple[Part, Part]:
    """Cut each trajectory, of these lengths, after its first `round(fraction * length)` samples.

    A trajectory that is too short to be cut trains whole. Of three trajectories or more, none of which has two parts
    that show their noise, whole ones are held out: see `held_out_whole`. Raise InputError if the fraction is not inside
    (0, 1), or no trajectory has two parts of three samples. Return the part that trains and the part that tests.
    """
    if not 0.0 < fraction < 1.0:
        raise InputError(f"fraction must lie between 0 and 1, got {fraction}; for example 2/3 trains on two thirds")
    cuts = cuts_of(lengths, fraction)
    rest = tuple(length - cut for cut, length in zip(cuts, lengths, strict=True) if cut < length)
    if not rest:
        most = max(lengths)
        first = round(fraction * most)
        raise InputError(
            f"{source or 'trajectories'}: fraction {fraction:g} cuts the {most} samples of trajectory "
            f"{lengths.index(most)} into {first} and {most - first}, each part needs {MIN_SAMPLES}; record more, "
            "change the fraction, or hold nothing out: --train-fraction 1 (train_fraction=1 in Python)"
        )
    train = leading(lengths, cuts)
    return (train.nonzero()[:, 0], cuts), ((~train).nonzero()[:, 0], rest)


def cut_of(length: int, fraction: float) -> int:
    """The number of samples that train: this fraction, or all if a part would have fewer than three samples."""
    cut = round(fraction * length)
    return cut if MIN_SAMPLES <= cut <= length - MIN_SAMPLES else length


def cuts_of(lengths: Sequence[int], fraction: float) -> tuple[int, ...]:
    """The number of samples of each trajectory that train."""
    whole = held_out_whole(lengths, fraction)
    if not any(whole):
        return tuple(cut_of(length, fraction) for length in lengths)
    return tuple(MIN_SAMPLES if out else length for out, length in zip(whole, lengths, strict=True))


def held_out_whole(lengths: Sequence[int], fraction: float) -> tuple[bool, ...]:
    """Which trajectories are held out whole, evenly chosen: all but this fraction of three or more short ones.

    Trajectories are short if none has two parts of `MIN_SHOWING_NOISE` samples. The first three samples of a trajectory
    that is held out train all the same: they give its starting state.
    """
    parts = (min(cut := round(fraction * length), length - cut) for length in lengths)
    if len(lengths) < 3 or fraction == 1 or max(parts) >= MIN_SHOWING_NOISE:
        return (False,) * len(lengths)
    # Of trajectories that can be held out the k-th one is where (1 − fraction) k passes the next whole number.
    found, count = [], 0
    for length in lengths:
        before, count = count, count + (length >= 2 * MIN_SAMPLES)
        found.append(round((1 - fraction) * count) > round((1 - fraction) * before))
    return tuple(found)


def trained_whole(lengths: Sequence[int], fraction: float) -> str:
    """A warning of trajectories that are too short to be cut, so that no sample is held out; "" for no trajectory."""
    whole = [b for b, length in enumerate(lengths) if cut_of(length, fraction) == length]
    if fraction == 1 or any(held_out_whole(lengths, fraction)) or len(whole) in (0, len(lengths)):
        return ""
    plural = "y is" if len(whole) == 1 else "ies are"
    return (
        f"warning: {len(whole)} of {len(lengths)} trajector{plural} too short to be cut at {fraction:g}, and nothing "
        f"is held out there: the first, number {whole[0]} from 0, has {lengths[whole[0]]} samples"
    )


def enough(kept: Tensor, lengths: Sequence[int]) -> Tensor:
    """The samples that are `kept`, (N,) bool, of trajectories that keep three or more; the others keep none."""
    return torch.cat([own & (int(own.sum()) >= MIN_SAMPLES) for own in kept.split(list(lengths))])


def leading(lengths: Sequence[int], counts: Sequence[int]) -> Tensor:
    """Which samples are among the first `counts[b]` of the `lengths[b]` samples of trajectory b, (N,) bool."""
    return torch.cat([torch.arange(length) < count for length, count in zip(lengths, counts, strict=True)])


def leading_rows(lengths: Sequence[int], counts: Sequence[int]) -> Tensor:
    """Rows of the samples that are `leading`."""
    return leading(lengths, counts).nonzero()[:, 0]


def liveliest_rows(q: Tensor, lengths: Sequence[int], most: int) -> Part:
    """About `most` samples at the most: of evenly chosen trajectories the samples in a row that move most."""
    own = min(max(most // len(lengths), MIN_ROW), max(lengths))
    stride = max(1, -(-own * len(lengths) // most))
    rows, kept = [], []
    size = q.std(0, correction=0).clamp_min(torch.finfo(q.dtype).tiny)
    for first, length in list(zip(offsets_of(lengths), lengths, strict=True))[::stride]:
        count = min(own, length)
        moved = (q[first : first + length].diff(dim=0) / size).square().sum(1).cumsum(0)
        gone = torch.cat([moved.new_zeros(1), moved])
        start = first + int((gone[count - 1 :] - gone[: length - count + 1]).argmax())
        rows.append(torch.arange(start, start + count))
        kept.append(count)
    return torch.cat(rows), tuple(kept)


def every_mth(lengths: Sequence[int], every: int) -> Tensor:
    """Return which samples of their trajectory are 0, m, 2m, …, (N,) bool, with m = `every`.

    Raise InputError if `every` is not a whole number >= 1, or leaves a trajectory fewer than three samples.
    """
    check_whole(1, every=every)
    least = min(lengths)
    if every > max(most := (least - 1) // (MIN_SAMPLES - 1), 1):
        raise InputError(
            f"every = {every} leaves {-(-least // every)} of the {least} samples of trajectory {lengths.index(least)}, "
            f"at least {MIN_SAMPLES} are needed; every may be at most {most} here"
        )
    return torch.cat([torch.arange(length) % every == 0 for length in lengths])


def inputs_of_kept(
    t: Tensor,  # (N,) time
    u: Tensor,  # (N, m) inputs; each acts from its sample to the next
    lengths: Sequence[int],
    kept: Tensor,  # (N,) bool
) -> Tensor:
    """Return the time-weighted mean of u over the step that starts at each kept sample, (kept, m)."""
    h = torch.cat([t.diff(), t.new_zeros(1)])
    # No step starts at the last sample of a trajectory, nor before the first kept sample.
    h[torch.tensor(lengths).cumsum(0) - 1] = 0
    h = h * torch.cat([part.cumsum(0) > 0 for part in kept.split(tuple(lengths))])
    step = (kept.cumsum(0) - 1).clamp_min(0)
    time = h.new_zeros(int(step[-1]) + 1).index_add(0, step, h)
    impulse = u.new_zeros(len(time), u.shape[1]).index_add(0, step, u * h[:, None])
    mean = impulse / time.clamp_min(torch.finfo(h.dtype).tiny)[:, None]
    return torch.where(time[:, None] > 0, mean, u[kept])
