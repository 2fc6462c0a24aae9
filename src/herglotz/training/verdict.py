"""`verdict`: one sentence that says how well a run fits its data, with a remedy if the model does not fit.

Three errors are compared with the precision of the data, which is estimated from the data alone:

* free runs over windows of 20 recorded steps of the training part, from the fitted states;
* the same windows over the unseen part, from states fitted there with fixed parameters, or from the states of the free
  run, whichever are nearer to the data;
* one free run over the whole unseen part, `extrapolation_rms`.

A model is rejected if a free run loses the motion, unless the uncertainty of its start and of the parameters explains
the loss, which then is no error of the model: chaotic motion leaves every model in the long run. A free run that fails
or diverges always rejects the model. So does a large uncertainty while the start alone lets the motion be followed
(`foresight`): many models fit a recording that is too short. So does a misfit above the noise if the data themselves
show a cause that the user can remove (`misread`). Errors of several coordinates are divided by the spread of each. If a
recording is too short to show its noise, the misfit of the training data replaces the noise.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any, cast

import torch
from torch import Tensor

from herglotz.data import Trajectories
from herglotz.data.noise import AT_THE_NOISE, coarse, precision, precisions, relative_spread
from herglotz.data.polar import Circle, circles, remedy
from herglotz.data.sensors import measured
from herglotz.data.splits import enough, leading
from herglotz.data.units import common_unit
from herglotz.models import own_name
from herglotz.stepping import Stepper, state_of
from herglotz.training import trades
from herglotz.training.errors_of_runs import APART, EXACT_ENOUGH, Errors
from herglotz.training.feedback import (
    caveat_of_inputs,
    held_by_inputs,
    reason_of_idle_inputs,
    reason_of_inputs,
    reason_of_set_points,
)
from herglotz.training.flow import motion
from herglotz.training.following import HALF
from herglotz.training.foresight import UNCERTAIN, Foresight, foresee
from herglotz.training.left_out import LeftOut, beside
from herglotz.training.look import Look
from herglotz.training.missed import MOST, OF_TIME, reason_of, reason_of_data, ways_of_columns
from herglotz.training.objectives import Fitted
from herglotz.training.problems.grid import FIRST_SEGMENT, segment_grid, step_inputs
from herglotz.training.problems.robust import FEW, FREEDOM, far_out, scale_of
from herglotz.training.properties import own_properties
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.trajectory_fit import SegmentStages, TrajectoryFit

FITS, WORSE, FAILS = "fits to the noise", "fits, worse than the noise", "does not fit"
# Standard deviations of a free run, by what the fit leaves open, within which a loss of the motion is no error.
CHANCE = 3.0
OF_WHAT_IS_OPEN = "What the fit leaves open of its start and of its numbers explains the error of the one run"
NO_NOISE = (
    "Noise is the same in both parts, and what the model misses is not: samples are too far apart for the motion, or a "
    "force is missing. Try a recording with more samples in the same time, or a --feature for that force"
)
# Standard errors by which a free run has to be better than the mean of the data.
CLEARLY = 2.0
# Most recordings of the same kind, as the root of their number: nobody records 900 times as much.
MAX_ROOT_OF_RECORDINGS = 30.0
# Iterations for the states of unseen windows: 2n unknowns from 20 samples need fewer.
STATE_ITERATIONS = 10


def window_errors(task: Task, fitted: Fitted, states: Tensor, data: Trajectories) -> Tensor:
    """Errors of free runs over windows of 20 recorded steps from states (N, 2n+1) at the samples, (N', n)."""
    grid = segment_grid(data, FIRST_SEGMENT, task.base.model_step)
    start, u = states[grid.start_sample], step_inputs(fitted.model, data, grid)
    with torch.no_grad():
        nodes = motion(fitted.model, start, grid.h, u)
        if nodes is None:
            nodes = Stepper(fitted.model).rollout(*state_of(start), h=grid.h, inputs=u).states.joined
    return grid.at_samples(nodes[..., : data.dof]) - data.q


def unseen_window_errors(task: Task, fitted: Fitted, data: Trajectories) -> Tensor:
    """Errors of windows of unseen data, (N', n), from states fitted there; inf if a step fails."""
    found = with_own_starts(task, fitted, data, FREEDOM if task.config.robust != "off" else None)
    if found is None:
        return data.q.new_full((1, data.dof), torch.inf)
    miss = found.misfit
    by = 1.0 if found.problem.freedom is None else scale_of(miss) / miss.square().mean().sqrt()
    return miss * by * data.balance


def with_own_starts(task: Task, fitted: Fitted, data: Trajectories, freedom: float | None) -> TrajectoryFit | None:
    """The fit of the states of windows, with fixed parameters; None if a step fails."""
    config = replace(task.config, iterations=STATE_ITERATIONS)
    stages = SegmentStages(replace(task, data=data, config=config, stages=Stages()), fitted.model, frozen=True)
    return stages.from_least_squares(fitted.sigma, freedom)


def _shown_reason(task: Task, fitted: Fitted, seen: Look, missed: bool, longer: str = "") -> str:
    """The reason that the inputs, and residuals above the noise (`missed`), show, or ""; `longer` is a remedy too."""
    known = fitted.states[~seen.spikes]
    reason = reason_of_inputs(fitted.model, task.data, known, task.base.model_step, longer, not missed)
    return ". ".join(filter(None, (reason, _reason_of_residuals(task, fitted, seen) if missed else "")))


def _reason_of_residuals(task: Task, fitted: Fitted, seen: Look) -> str:
    """The reason of a misfit in words that the residuals show; "" if they show none.

    If steps are so short that noise hides the curvature, every second, fourth, … sample is tried.
    """
    train, steps, reason = seen.train, 1, None
    while reason is None:
        data, base = train.liveliest(MOST), task.base.stepped(steps)
        found = with_own_starts(replace(task, base=base), fitted, data, None)
        # A model that cannot be stepped explains nothing: what it misses is the motion.
        miss = data.q if found is None else found.problem.misfit(found.path) * data.balance
        grid = found and found.problem.grid
        owner = data.trajectory if grid is None else grid.node // (grid.longest + 1)
        reason = reason_of(data, miss, owner, "full" if own_name(fitted.model) else task.config.level)
        if min(train.lengths) < 2 * FIRST_SEGMENT or coarse(half := train.thinned(2)):
            break
        train, steps = half, 2 * steps
    return reason or ""


def changes_with_time(task: Task, fitted: Fitted, seen: Look, outlying: tuple[LeftOut, ...]) -> bool:
    """Whether a model misses what changes with time, in the recordings that are not `outlying`, too.

    Such a law, of a mass that grows, misses one recording most and is the law of all.
    """
    out = {one.recording for one in outlying}
    train = seen.train.select([b for b in range(len(seen.train)) if b not in out])
    return _reason_of_residuals(task, fitted, replace(seen, train=train)).startswith(OF_TIME)


def _gross(windows: Tensor, data: Trajectories) -> Tensor:
    """Samples with gross errors, (N,) bool; none if the outliers are too many. Windows start at first samples."""
    out = far_out(windows / windows.abs().median(0).values.clamp_min(1e-300))
    out[list(data.offsets)] = False
    return out if float(out.double().mean()) <= FEW else torch.zeros_like(out)


def judged(
    task: Task,
    seen: Look,
    fitted: Fitted,
    everywhere: Tensor,  # (N, 2n+1)
    free: Tensor | None,  # (M, n)
    metrics: dict[str, Any],
) -> dict[str, Any]:
    """The verdict and its errors, without the samples that the fit rejects as gross errors.

    `everywhere` holds the states at all samples, `free` the errors of the free run over the unseen part (None: nothing
    was held out), and `metrics` the numbers of the fit so far.
    """
    used = torch.ones_like(task.data.t, dtype=torch.bool) if fitted.used is None else fitted.used
    # Of a bad recording the fit may use too few samples for a motion.
    used = enough(used, task.data.lengths)
    kept, states = task.data.keep(used), fitted.states[~seen.spikes]
    windows = window_errors(task, fitted, states[used], kept)
    out = _gross(windows, kept) if fitted.notes.get("robust") else torch.zeros_like(kept.t, dtype=torch.bool)
    out &= kept.complete
    good = enough(~out, kept.lengths)
    kept, windows = kept.keep(good), windows[good & kept.complete]
    held_out = seen.unseen is not None and bool(seen.unseen.complete.any())
    unseen = unseen_window_errors(task, fitted, cast(Trajectories, seen.unseen)) if held_out else None
    unit = kept.q.std(0, correction=0).clamp_min(1e-300) if kept.dof > 1 else kept.q.new_ones(1)
    if unseen is not None and free is not None and _rms(unseen / unit) > _rms(free / unit):
        unseen = free
    errors = _errors(kept, unit, (windows, unseen, free), int(out.sum()))
    ahead = foresee(task, fitted, seen, everywhere)
    numbers = {"window_rms": _rms(windows), "unseen_window_rms": None if unseen is None else _rms(unseen)}
    numbers["precision"] = precision(kept)
    kept_numbers = {k: v if v is not None and math.isfinite(v) else None for k, v in numbers.items()}
    shown = partial(_shown_reason, task, fitted, seen)
    model, train = fitted.model, task.data
    reasons = reason_of_set_points(model, train) if errors.missed else "", reason_of_idle_inputs(model, train, states)
    words = ". ".join(filter(None, (misread(kept, seen, errors.missed), *reasons)))
    caveat = caveat_of_inputs(model, train, states)
    beyond = partial(unseen_outlier, seen, everywhere)
    told = metrics | {
        "driven": train.u is not None, "level": task.config.level, "angles": _never_turned(train),
        "columns": ways_of_columns(train), "own": own_name(model), "time_unit": train.time_unit,
    }  # fmt: skip
    held = partial(held_by_inputs, model, train, states, task.base.model_step)
    return {"verdict": in_words(errors, ahead, told, shown, words, caveat, beyond, held)} | kept_numbers


def _never_turned(data: Trajectories) -> bool:
    """Whether the data have angles, and none of these goes through a whole turn: each may be a position on a line."""
    turning = torch.tensor(data.angles, device=data.q.device)
    return bool(turning.any()) and bool(((data.q.amax(0) - data.q.amin(0))[turning] < 2 * math.pi).all())


def _errors(kept: Trajectories, unit: Tensor, missed: tuple[Tensor, Tensor | None, Tensor | None], out: int) -> Errors:
    """The errors of windows, unseen windows and the free run as RMS, over `unit` (n,); `out` samples were left out."""
    scaled = replace(kept, q=kept.q / unit)
    windows, unseen, free = (None if x is None else _rms(x / unit) for x in missed)
    named, in_degrees = (common_unit(kept.units), bool(kept.degrees)) if kept.dof == 1 else (None, False)
    rough = (precisions(scaled) > HALF).tolist() if kept.dof > 1 else [True]
    names = () if all(rough) else tuple(name for name, own in zip(kept.names, rough, strict=True) if own)
    assert windows is not None
    spread = _rms(scaled.q - scaled.q.mean(0))
    return Errors(windows, unseen, free, precision(scaled), spread, named, in_degrees, out, names, coarse(scaled))


def unseen_outlier(seen: Look, everywhere: Tensor) -> str:
    """The only one of three or more recordings whose unseen part a free run misses, in words with a remedy; else ""."""
    data = seen.data
    miss = ((everywhere[:, : data.dof] - data.q) / data.balance).nan_to_num(nan=torch.inf)
    unseen = (~leading(data.lengths, seen.train.lengths)).to(miss.device) & data.complete
    parts = [
        (b, own[there], t[there])
        for b, (own, t, there) in enumerate(zip(*(x.split(data.lengths) for x in (miss, data.t, unseen)), strict=True))
        if bool(there.any())
    ]
    if len(parts) < 3:
        return ""
    recordings, missed, t = zip(*parts, strict=True)
    least = EXACT_ENOUGH * relative_spread(data)
    found = [beside(k, missed, t, least, data.label(b)) for k, b in enumerate(recordings)]
    out = [one for one in found if one.stands_out]
    if len(out) != 1:
        return ""
    (one,) = out
    since = float(t[one.recording][0]) if one.since is None else one.since
    recording = recordings[one.recording]
    return one._replace(recording=recording, since=since, properties=own_properties(data, recording)).reason


def misread(kept: Trajectories, seen: Look, missed: bool) -> str:
    """What is wrong with the recording or with its reading, in words with a remedy; "" if nothing is seen to be wrong.

    Two positions with one degree of freedom (`bound`) are wrong whatever the errors. If the training data are `missed`
    by more than the noise, so is a recording that stands out, and what `reason_of_data` finds.
    """
    # A drift may make up for a constraint, which the readings keep.
    as_read = measured(kept, drifts=[-rate for rate in seen.drifts])
    if (words := in_proportion(as_read) or bound(as_read)) or not missed:
        return words
    return "".join(one.reason for one in seen.outlying) or reason_of_data(seen.train.liveliest(MOST))


def in_proportion(data: Trajectories) -> str:
    """A pair of positions that are in proportion within their precision, with a remedy; "" if there is none.

    Each recording has a constant of its own: encoders begin at any count.
    """
    noise = precisions(data).to(data.q) * data.balance
    x = torch.cat([(one.q - one.q.mean(0))[one.complete] for one in data])
    moving = (noise <= HALF * x.square().mean(0).sqrt()).nonzero()[:, 0].tolist()
    for i, j in combinations(moving, 2):
        by = float((x[:, i] @ x[:, j]) / x[:, i].square().sum())
        left = float((x[:, j] - by * x[:, i]).square().mean().sqrt())
        if left <= AT_THE_NOISE * math.hypot(float(noise[j]), by * float(noise[i])):
            one, other = data.names[i], data.names[j]
            return (
                f"{other} moves by {by:.4g} times what {one} does, to the precision of both, as where one shaft turns "
                "another, and what holds them together was not recorded: they are one coordinate. Try --drop "
                f"{shlex.quote(other)}, or motions in which they differ"
            )
    return ""


def bound(data: Trajectories) -> str:
    """Pairs of positions that stay on circles within their precision, in words with a remedy; "" if there are none.

    A pair has one degree of freedom. The constraint force is not recorded, and a free run leaves the circle.
    """
    noise, size = precisions(data).to(data.q) * data.balance, data.q.std(0, correction=0)

    def is_kept(one: Circle) -> bool:
        at = list(one.columns)
        return one.error <= AT_THE_NOISE * float(noise[at].maximum(EXACT_ENOUGH * size[at]).square().mean().sqrt())

    found = [one for one in circles(replace(data, notes=())) if is_kept(one)]
    if not found:
        return ""
    kept = (
        f"The positions {', and '.join(one.description for one in found)}, and what holds them there was not recorded"
    )
    flags, many = remedy(found)
    one, other = ("each", "them") if many else ("it", "it")
    return f"{kept}. Try {flags}, which makes one angle of {one}, or motions that leave {other}"


def in_words(
    errors: Errors,
    ahead: Foresight | None,
    metrics: dict[str, Any],
    shown: Callable[..., str] = lambda *_: "",
    misread: str = "",
    caveat: str = "",
    beyond: Callable[[], str] = str,
    held: Callable[[], str] = str,
) -> str:
    """One of the three verdicts, with numbers and, if the model does not fit, a remedy.

    `shown` gives the reason of a model that misses the training data, or of one that does not, with a remedy
    (`herglotz.training.missed`, `herglotz.training.feedback`); `misread` says what is wrong with the recording,
    `caveat` what a model that fits rests on, and `beyond` says why unseen data differ from the training data. `held`
    says that inputs hold an unstable motion: no free run over all unseen time follows it, and windows at the noise
    judge alone.
    """
    free, missed = errors.free or 0.0, errors.missed
    if misread:
        return f"{FAILS}: {errors}. {misread}"
    follows = metrics.get("follows_data", True) and max(errors.windows, errors.unseen or 0.0) <= errors.lost
    met = not missed and errors.unseen is not None and errors.unseen <= AT_THE_NOISE * errors.limit
    unstable = held() if met and not free <= errors.lost else ""
    if not follows or not (math.isfinite(free) or unstable):
        return f"{FAILS}: {errors}. {_remedy(errors, metrics, shown, beyond)}"
    if errors.windows > HALF * errors.spread and (words := _half_missed(errors, metrics)):
        return f"{FAILS}: {words}"
    if unstable:
        return ". ".join(filter(None, (f"{_fits(replace(errors, free=None))}: {errors}", unstable, caveat)))
    # The errors of what is left open and those of a model know nothing of each other.
    chance = 0.0 if ahead is None else min(CHANCE * ahead.unseen, ahead.apart) * errors.spread
    if free > math.hypot(errors.lost, chance):
        return f"{FAILS} beyond the recording: {errors}. {_remedy(errors, metrics, shown, beyond)}"
    if ahead is not None and ahead.open > UNCERTAIN:
        return f"{FAILS}: {_left_open(ahead, errors, metrics, shown)}"
    # What is lost here is so by what is left open, which is no error of the model.
    by_chance = free > errors.lost
    fits = f"{_fits(replace(errors, free=None) if by_chance else errors)}: {errors}"
    why = _why_by_chance(cast(Foresight, ahead), metrics) if by_chance else ""
    return ". ".join(filter(None, (fits, why, shown(True) if missed else caveat)))


def _why_by_chance(ahead: Foresight, metrics: dict[str, Any]) -> str:
    if not math.isfinite(ahead.followed):
        return OF_WHAT_IS_OPEN
    return f"{OF_WHAT_IS_OPEN}: after {_time(ahead.followed, metrics)} the start alone loses it, whatever the law"


def _time(value: float, metrics: dict[str, Any]) -> str:
    """A time with the unit of the data."""
    unit = metrics.get("time_unit", "1")
    return f"{value:.3g} {'units of time' if unit in ('', '1') else unit}"


def _fits(errors: Errors) -> str:
    """How well a model fits that follows the motion: to the noise, or to what replaces the noise, or worse."""
    known = math.isfinite(errors.noise)
    if errors.worst <= AT_THE_NOISE * errors.limit:
        beyond = known and errors.worst > AT_THE_NOISE * errors.noise
        return f"{FITS}, or to {EXACT_ENOUGH:g} of the spread" if beyond else FITS
    stands = "" if known else ", for which its misfit of the training data stands,"
    return f"{WORSE}{stands} by a factor of {errors.worst / errors.limit:.2g}"


def _half_missed(errors: Errors, metrics: dict[str, Any]) -> str:
    """The verdict on windows that miss more than half of the spread; "" if they may be right, in much noise.

    Windows of pure noise, whose starts are fitted, have an error of 0.9 to 0.95 of the spread.
    """
    if errors.unseen is not None and APART * errors.unseen < errors.windows:
        return f"{errors}. {NO_NOISE}"
    return "" if (metrics.get("gain_over_mean") or 0.0) > CLEARLY else _unseen_motion(errors)


def _unseen_motion(errors: Errors) -> str:
    """The verdict where no motion stands out from the noise: of all coordinates, or of those without inertia."""
    if not errors.rough:
        return f"no motion stands out from the noise; {errors}. Try less noise, or a longer recording"
    names, verb = ",".join(errors.rough), "moves" if len(errors.rough) == 1 else "move"
    what, flag = f"{names} {verb} from sample to sample as no mass does; {errors}", shlex.quote(names)
    return f"{what}. Try --inputs {flag} where the others follow what is commanded, else --drop {flag}"


def _left_open(ahead: Foresight, errors: Errors, metrics: dict[str, Any], shown: Callable[..., str]) -> str:
    """The verdict on a model that the data do not determine, with the recording that would help."""
    over, missed = f"over the next {_time(ahead.horizon, metrics)}", errors.missed
    if not ahead.reached:
        return f"the model's own motion breaks off {over}; {errors}. {_remedy(errors, metrics, shown)}"
    what, share = f"a force too small to be seen ({trades.in_words(ahead.name)})", ahead.hidden
    if ahead.parameters >= ahead.hidden:
        what, share = "the uncertainty of the parameters", ahead.parameters
    changes = f"{what[0].upper()}{what[1:]} may change the motion {over} by {100 * share:.2g} % of its spread"
    if missed:
        return f"a force is missing, and others are left open; {errors}. {changes}. {_remedy(errors, metrics, shown)}"
    # The uncertainty falls with the root of the number of samples.
    times = (ahead.open / UNCERTAIN) ** 2
    enough = times <= MAX_ROOT_OF_RECORDINGS**2
    longer = f"a recording {max(2, math.ceil(times))} times as long, or several from other starts" if enough else ""
    if reason := shown(False, longer):
        return f"the inputs leave it open; {errors}. {changes}. {reason}"
    if not enough:
        return f"such motions do not tell, however many; {errors}. {changes}. Try other motions: starts, inputs, speeds"
    return f"too little was recorded to tell; {errors}. {changes}. Try {longer}"


def _remedy(errors: Errors, metrics: dict[str, Any], shown: Callable[..., str], beyond: Callable[[], str] = str) -> str:
    """The remedy, after the reason if one is shown."""
    if reason := shown(errors.missed):
        return reason
    if not errors.missed:
        return beyond() or _unlike(errors, metrics)
    columns, own = metrics.get("columns", ()), metrics.get("own")
    if metrics["objective"] in ("residual", "raw"):
        ways = ", or ".join(["Try --objective trajectory", *columns])
        asked = "" if columns else "; inputs that are not recorded?"
        return f"{ways}; or --substeps where a period has few samples{asked}"
    if own:
        return f"A force is missing, or the fit has not found it. Try other first values of {own}, or more terms in it"
    ways = [*columns, *([] if metrics["objective"] == "smoothing" else ["--objective smoothing"])]
    # Inputs leave one level.
    ways += [] if metrics.get("driven") else ["another --level (herglotz select)"]
    told = f"A force is missing. Try {', or '.join([*ways, 'a --feature for it'])}"
    if metrics.get("driven") or columns:
        return told
    return (
        f"{told}; where motors, hands or other bodies drive the motion, record their forces (--inputs), as no input was"
    )


def _unlike(errors: Errors, metrics: dict[str, Any]) -> str:
    """Why a model that meets the training data misses the unseen part, or one run over that part, with a remedy."""
    driven, own = metrics.get("driven"), metrics.get("own")
    if (errors.unseen or 0.0) > AT_THE_NOISE * errors.limit:
        # Inputs leave one level.
        simple = driven or own or metrics.get("level") in ("conservative", "linear")
        simpler = "" if simple else "--level linear, or "
        return f"Try {simpler}a larger train fraction: the unseen part differs from the training part"
    met = "the data" if errors.unseen is None else "the unseen part, too"
    noisy = "from noise of the inputs, " if driven else ""
    ways = ["--angles none, where a spring and not gravity holds the angle"] if metrics.get("angles") else []
    ways = [f"more terms in {own}"] if own else [*ways, "a --feature for that force"]
    return (
        f"Runs over {FIRST_SEGMENT} steps meet {met}: errors of a longer run come from a force too small to be seen in "
        f"these, {noisy}or from chaos, which no run follows for long. Try {', or '.join(ways)}, or a longer "
        "recording; herglotz predict with --windows and --horizon scores shorter runs"
    )


def _rms(x: Tensor) -> float:
    value = float(x.double().square().mean().sqrt())
    return value if math.isfinite(value) else math.inf
