"""Recordings that the model of the others does not follow: something else was recorded, and they are left out whole.

Of every recording the part that a fit uses is followed from a start of its own, with the numbers of the model fixed:
as a whole by a model that a search has found, else over short segments. Twenty steps hide a damping that is a fifth
larger, or a scale that is wrong by 3 %. A recording disagrees if more than a tenth of its readings (`reach`) are
outliers (`TAIL`) of the misfit of the others, which the model meets to their noise: fewer are single ones, and what the
error of the model's steps explains is no outlier. A bad recording may have bent the model so far that the others are
missed as well, as where the law is wrong. The recording that is missed most, or else the one whose accelerations are
least like the others', is then left out if the whole dictionary would follow the others to their noise. The model is
then found anew. What is left out stays so if the others agree, whose model is at their noise, and if it is an outlier
of that model. Most recordings have to agree.

Where nothing is left out, as where no terms are searched (more than three coordinates, a given plan, own terms), an
outlier of the finished model is named (`outlying`).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.noise import AT_THE_NOISE, TAIL, precision, relative_spread
from herglotz.data.sensors import measured
from herglotz.data.splits import cuts_of, held_out_whole, leading
from herglotz.models import ContactLagrangian
from herglotz.training.baseline import differences, estimate_baseline
from herglotz.training.config import FitConfig
from herglotz.training.errors_of_runs import EXACT_ENOUGH
from herglotz.training.left_out import NORMAL_REACH, LeftOut, beside, reach, scale_of_all, since
from herglotz.training.look import Look, look, read_like
from herglotz.training.problems.robust import FREEDOM, robust_fit, scale_of
from herglotz.training.properties import own_properties
from herglotz.training.search import Search
from herglotz.training.stages import Stages
from herglotz.training.structure import MOST, search_between_coupled
from herglotz.training.trajectory_fit import SegmentStages
from herglotz.training.trials import explained_by_steps
from herglotz.training.verdict import STATE_ITERATIONS


def look_at_agreeing(data: Trajectories, settings: FitConfig, stages: Stages) -> tuple[Look, tuple[LeftOut, ...]]:
    """The look at the recordings that agree, and those that are left out: see the head of this module.

    Raise InputError if the data cannot be used, or do not suit the settings.
    """
    whole = seen = look(data, settings, stages)
    out: list[int] = []
    for _ in range(len(data)):
        if (missed := _missed(seen, data, out)) is None:
            break
        rest = [b for b in range(len(data)) if b not in out]
        if (bad := _disagreeing(seen, data, rest, missed)) is not None:
            now = sorted([*out, bad])
        else:
            far = [reach(own) for own in missed]
            least = scale_of_all([missed[b] for b in rest], _least(seen))
            now = [b for b in out if far[b] > TAIL * least]
            if not _agree(seen, precision(seen.data)):
                break
            if now == out:
                t = _times(_followed(data, seen.settings))
                return seen, tuple(LeftOut(b, far[b], least, data.label(b), since(missed[b], t[b], least)) for b in out)
        if 2 * len(now) >= len(data):
            break
        out = now
        others = data.select([b for b in range(len(data)) if b not in out])
        seen = look(others, settings, stages.labelled(f"{stages.label}, without {out}"))
    return whole, ()


def _disagreeing(seen: Look, data: Trajectories, rest: Sequence[int], missed: Sequence[Tensor]) -> int | None:
    """The recording among `rest` that is an outlier of the misfits of the others, or that bends the model, or None.

    None, too, if the recording has a property of its own: the law may depend on that property.
    """
    worst = max(rest, key=lambda b: reach(missed[b]))
    remaining = [b for b in rest if b != worst]
    others, far = scale_of_all([missed[b] for b in remaining], _least(seen)), reach(missed[worst])
    met = others <= max(AT_THE_NOISE * precision(data.select(remaining)), _least(seen))
    if met and far > TAIL * others and far > _of_steps(seen, data, worst):
        bad = worst
    else:
        # Once a recording is left out, the model is no longer bent.
        asked = dict.fromkeys((worst, _least_alike(seen))) if len(rest) == len(data) else ()
        bad = next((b for b in asked if _bends(seen, b)), None)
    return None if bad is None or own_properties(data, bad) else bad


def outlying(seen: Look, model: ContactLagrangian, sigma: float) -> tuple[LeftOut, ...]:
    """The recording that a finished model misses most, if it is an outlier; () if none is, or of two recordings.

    That recording may have bent the model. If it is missed by more than the noise, the numbers of the model are fitted
    once more to short segments of the others, and it is compared with these.
    """
    if len(seen.data) < 3:
        return ()
    followed = _followed(seen.data, seen.settings)
    worst = _worst(seen, _missed_by(seen, model, sigma, followed), followed)
    others = _but(seen, worst.recording)
    noise = precision(seen.data.select(others))
    if worst.missed <= max(AT_THE_NOISE * NORMAL_REACH * noise, TAIL * _least(seen)):
        return ()
    stages = SegmentStages(replace(seen.task(Stages()), data=followed.select(others)), own := deepcopy(model))
    if (found := stages.fit(stages.lengths[0], noise, None, None)) is None:
        return ()
    found.problem.parameters.set(found.theta)
    now = _worst(seen, _missed_by(seen, own, noise, followed), followed)
    now = now._replace(properties=own_properties(seen.data, now.recording))
    # Where the others are missed as well, it is the law that is wrong.
    agree = now.others <= max(AT_THE_NOISE * noise, _least(seen))
    return (now,) if agree and now.stands_out and now.recording == worst.recording else ()


def _worst(seen: Look, missed: Sequence[Tensor], followed: Trajectories) -> LeftOut:
    """The recording that is missed most."""
    most = max(range(len(missed)), key=lambda b: reach(missed[b]))
    return beside(most, missed, _times(followed), _least(seen), seen.data.label(most))


def _times(data: Trajectories) -> list[Tensor]:
    """The times of the samples of each recording of which all positions were read."""
    return [t[there] for t, there in zip(data.t.split(data.lengths), data.complete.split(data.lengths), strict=True)]


def _least(seen: Look) -> float:
    """The misfit below which the verdict counts errors as none."""
    return EXACT_ENOUGH * relative_spread(seen.data)


def _agree(seen: Look, noise: float) -> bool:
    """Whether the model misses what it was fitted to by no more than this noise."""
    assert seen.found is not None
    sigma = seen.found.sigma
    return sigma is not None and sigma <= max(AT_THE_NOISE * noise, _least(seen))


def _least_alike(seen: Look) -> int:
    """The recording whose accelerations are farthest from the linear model that Student's t fits to those of all."""
    found = differences(seen.data)
    rows, right = found.equations
    missed = (rows @ robust_fit(rows, right) - right).reshape(found.a.shape)
    of = seen.data.trajectory[found.triples.index].cpu()
    return max(range(len(seen.data)), key=lambda b: scale_of(missed[of == b]) if bool((of == b).any()) else 0.0)


def _bends(seen: Look, recording: int) -> bool:
    """Whether the model misses the data by more than the noise of the other recordings, and whether the whole
    dictionary follows these to it.

    The dictionary has to follow the readings as they are, or less the zeros that were found: a bent model has zeros
    that no sensor has.
    """
    others = seen.kept.select(_but(seen, recording)).to(torch.float64, "cpu")
    if _agree(seen, precision(others)):
        return False
    as_recorded = measured(seen.kept, [-zero for zero in seen.zeros]).select(_but(seen, recording))
    readings = [as_recorded.to(torch.float64, "cpu"), *([others] if seen.zeros else [])]
    return any(_met_by_the_dictionary(seen, own) for own in readings)


def _met_by_the_dictionary(seen: Look, data: Trajectories) -> bool:
    """Whether the whole dictionary follows these recordings to their noise."""
    base = estimate_baseline(data)
    if data.dof > MOST:
        search = search_between_coupled(data, base, seen.settings, outliers=False)
    else:
        search = Search(data, base, replace(seen.settings, features=(), dtype="float64", device="cpu"))
    full = None if isinstance(search, str) else search.part.full
    return full is not None and full.at_the_noise


def _but(seen: Look, recording: int) -> list[int]:
    """All recordings but one."""
    return [b for b in range(len(seen.data)) if b != recording]


def _missed(seen: Look, data: Trajectories, out: Sequence[int]) -> list[Tensor] | None:
    """Sizes of the misfit (N', n) of each recording, over the balance, at samples of which all positions were read.

    Infinite where a step fails. None where no named terms were found, and where recordings differ by zeros of their
    sensors, since those of recordings that are `out` are unknown.
    """
    if len(data) < 3 or seen.found is None or seen.found.sigma is None or (out and seen.zeros):
        return None
    read = _followed(read_like(data, seen), seen.settings)
    # A model that a search has found follows whole recordings.
    return _missed_by(seen, seen.task(Stages()).build("none"), seen.found.sigma, read, whole=True)


def _missed_by(
    seen: Look, model: ContactLagrangian, sigma: float, read: Trajectories, *, whole: bool = False
) -> list[Tensor]:
    """The same of a model and of recordings as the look has read its own, by short segments or as a `whole`."""
    found = _misfit(seen, model, sigma, read, whole)
    each = [_misfit(seen, model, sigma, one, whole) for one in read] if found is None else found.split(read.lengths)
    known = read.complete.split(read.lengths)
    return [
        read.q.new_full((1, 1), torch.inf) if own is None else (own / read.balance)[there].abs()
        for own, there in zip(each, known, strict=True)
    ]


def _followed(data: Trajectories, settings: FitConfig) -> Trajectories:
    """The part of every recording that a fit uses, or all of a recording that is held out whole."""
    held = held_out_whole(data.lengths, settings.train_fraction)
    cuts = cuts_of(data.lengths, settings.train_fraction)
    kept = [length if whole else cut for length, cut, whole in zip(data.lengths, cuts, held, strict=True)]
    return data.keep(leading(data.lengths, kept).to(data.q.device))


def _of_steps(seen: Look, data: Trajectories, recording: int) -> float:
    """The largest misfit (`reach`) of a recording that the error of the model's steps explains; 0 where a step fails.

    Steps miss fast motion by more than slow motion. The error is the change of the misfit by steps of half the size,
    with states of their own: what steps do not explain, as readings of nothing, such steps miss as well.
    """
    assert seen.found is not None
    assert seen.found.sigma is not None
    read = _followed(read_like(data, seen), seen.settings).select([recording])
    finer = replace(seen, base=replace(seen.base, model_step=seen.base.model_step / 2))
    long, short = (
        _misfit(one, one.task(Stages()).build("none"), seen.found.sigma, read, True) for one in (seen, finer)
    )
    if long is None or short is None:
        return 0.0
    change = ((short - long) / read.balance)[read.complete]
    return explained_by_steps(reach(change), seen.settings.order)


def _misfit(seen: Look, model: ContactLagrangian, sigma: float, data: Trajectories, whole: bool) -> Tensor | None:
    """Misfit of segments that start anew, (N, n) in units of q; None if a step fails."""
    config = replace(seen.settings, iterations=STATE_ITERATIONS)
    stages = SegmentStages(replace(seen.task(Stages()), data=data, config=config), model, frozen=True)
    found = stages.all_followed(sigma) if whole else None
    if found is None:
        found = stages.from_least_squares(sigma, FREEDOM)
        # The first samples of a pendulum that rests near the top do not tell to which side the pendulum falls.
        if whole and found is not None:
            found = stages.grow(found, sigma)
            if found.problem.grid.length < stages.lengths[-1]:
                return None
    return None if found is None else found.problem.misfit(found.path) * data.balance
