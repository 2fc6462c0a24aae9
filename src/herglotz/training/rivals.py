"""Named terms, none, or networks: each is fitted to the first part of the training data, and runs free over the rest.

Free runs on held-out time decide what no residual can. It costs one fit of each: named terms start from the values that
their search found on all training data, and are alone where they meet the held-out time at the noise already. The
richer model has to err less by a twentieth: named terms than friction and inputs alone, which one coordinate is tried
with, and networks than both. These are tried on as few samples as tell the motion. Where named terms lose, the last fit
goes on from what the winner has learned.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

from herglotz.data import MIN_SAMPLES, Trajectories
from herglotz.data.roughness import AT_THE_NOISE, precision, sparsest
from herglotz.schema import from_plain
from herglotz.training.choose import choose
from herglotz.training.config import FitConfig
from herglotz.training.cross_validation import MARGIN
from herglotz.training.evaluate import free_run_errors
from herglotz.training.look import Look, look
from herglotz.training.named_terms import DRAG, STILL
from herglotz.training.objectives import OBJECTIVES
from herglotz.training.one_step_fit import NOISE_OF_R
from herglotz.training.plan import Plan
from herglotz.training.sensor_zeros import Apart, refined, sensor_zeros
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.verdict import unseen_window_errors

REFINED = 2  # searches for terms with better zeros
WORTH = 0.8  # of the error over held-out time without zeros: what zeros have to lower it to
FOLLOWS = 0.5  # of the spread: a free run that misses by more is lost, and tells nothing of terms
INNER = 0.75  # of the training part that rivals are fitted to
DROWNED = 0.1  # of a recorded step's curvature: noise above it would be most of what one-step errors minimise


def held_out_winner(data: Trajectories, config: FitConfig, stages: Stages, seen: Look) -> tuple[Look, Plan]:
    """The plan whose free run over the last quarter of the training part errs less, with its look at the data."""
    named, shortest = choose(seen, config), min(seen.train.lengths)
    if shortest - round(INNER * shortest) < MIN_SAMPLES:
        return seen, _reasoned(named, f"{shortest} samples of a recording leave none to hold out")
    first = stages.keep("held out, named terms", lambda: _held_out(seen, config, named))
    if first["rms"] > AT_THE_NOISE * precision(seen.kept):
        seen, first = _aligned(data, config, stages, seen, first)
        named = choose(seen, config)
    if first["rms"] <= AT_THE_NOISE * precision(seen.kept):
        return seen, _reasoned(
            named, f"free runs over held-out time miss {first['rms']:.2g} with named terms: the noise"
        )
    if seen.found is None or not seen.found.doubt:
        return seen, named
    model = "named terms"
    if (fewer := _without_terms(seen)) is not None:
        bare = stages.keep("held out, no terms", lambda: _held_out(fewer, config, choose(fewer, config)))
        if bare["rms"] <= FOLLOWS * _spread(seen) and not bare["rms"] > MARGIN * first["rms"]:
            seen, first, model = _going_on(fewer, bare), bare, "friction and inputs alone"
            named = choose(seen, config)
    asked, every = _as_fitted(seen, config, named)
    other = _without_names(data, asked, stages, seen)
    networks = choose(other, asked)
    second = stages.keep("held out, networks", lambda: _held_out(seen, config, networks, every))
    why = f"free runs over the last quarter of the training part miss {first['rms']:.2g} with {model}, "
    why += f"{second['rms']:.2g} with networks ({networks.objective})"
    if lost := min(first["rms"], second["rms"]) > _spread(seen):
        why += f"; both are lost: with errors up to the spread they miss {first['until']:.2g} and {second['until']:.2g}"
    if first[by := "until" if lost else "rms"] <= MARGIN * second[by]:
        return seen, _reasoned(named, why)
    if networks.objective == "trajectory":
        networks = replace(networks, every=named.every)  # longer steps would change the motion
    if networks.objective == "trajectory" and "departure" in second:
        other = _going_on(other, second)
        networks = replace(
            networks, start={**networks.start, **other.base.start}, sigma=second["sigma"],
            departures=(second["departure"],), fitted_before=True,
            reasons={**networks.reasons, "fitted_before": "to three quarters of the training part"},
        )  # fmt: skip
    return other, _reasoned(networks, why)


def _without_names(data: Trajectories, config: FitConfig, stages: Stages, seen: Look) -> Look:
    """The look that networks start from; inputs arrive as the named terms have shown."""
    data = data if data.u is None else replace(data, hold=seen.arrival.hold)
    other = look(data, config, _of(stages, seen.zeros), named=False, zeros=seen.zeros)
    other = other if data.u is None else replace(other, why_arrival=seen.why_arrival)
    return replace(other, apart=seen.apart) if seen.apart else other


def _aligned(
    data: Trajectories, config: FitConfig, stages: Stages, seen: Look, first: dict[str, Any]
) -> tuple[Look, dict[str, Any]]:
    """With zeros of the sensors in each recording, where free runs over held-out time miss it less with them."""
    if config.find_zeros is False or seen.found is None or not seen.found.apart:
        return seen, first
    apart = _kept(stages, "zeros", lambda: sensor_zeros(data, config, seen))
    if apart is None:
        return replace(seen, apart=""), first
    told = replace(seen, apart=apart.differs and f"{apart.differs}; zeros of the sensors do not explain that")
    if not apart.zeros:
        return told, first
    other = look(data, config, _of(stages, apart.zeros), zeros=apart.zeros)
    for k in range(REFINED):
        more = _kept(stages, f"zeros, round {k + 1}", lambda of=apart, by=other: refined(of, by))
        if more is None:
            break
        apart, other = more, look(data, config, _of(stages, more.zeros), zeros=more.zeros)
    plan = choose(other, config)
    if plan.network != "none":
        return told, first
    second = stages.keep("held out, other zeros", lambda: _held_out(other, config, plan))
    numbers = (f"{x['windows']:.2g} and {x['rms']:.2g}" for x in (second, first))
    words = "{}; over held-out time windows and one free run miss {} with them, {} without".format(apart, *numbers)
    if not _both(second, seen) < WORTH * _both(first, seen):  # also where both are lost
        return told, first
    return replace(other, apart=words), second


def _without_terms(seen: Look) -> Look | None:
    """One coordinate with no named force but friction and inputs; None where it has no other.

    Where residuals are no noise, as under forces that no model knows of, terms take them over and go on with them.
    """
    c = seen.settings
    if seen.train.dof > 1 or not (c.features or c.drag):
        return None
    start = {name: values for name, values in seen.base.start.items() if name not in (STILL, DRAG)}
    words = f"{', '.join((*c.features, *c.drag))} lower the error of free runs over held-out time by too little"
    return replace(
        seen, settings=replace(c, features=(), drag=(), order=2), base=replace(seen.base, start=start), structure=words
    )


def _going_on(seen: Look, found: dict[str, Any]) -> Look:
    """From the parameters that were fitted to the first part."""
    start = {name: tuple(values) for name, values in found["start"].items()}
    named = seen.found and seen.found._replace(sigma=found["sigma"])
    return replace(seen, base=replace(seen.base, start={**seen.base.start, **start}), found=named)


def _both(found: dict[str, Any], seen: Look) -> float:
    """Geometric mean of both errors over held-out time; a free run that is lost, as of chaos, misses by the spread."""
    return (found["windows"] * min(found["rms"], _spread(seen))) ** 0.5


def _as_fitted(seen: Look, config: FitConfig, named: Plan) -> tuple[FitConfig, int]:
    """The settings of networks, and how many samples are one where they are tried: what is tried is what is fitted.

    One-step errors of all samples would teach them another model where single recorded steps drown in noise: whole
    trajectories are tried on the samples that named terms are fitted to.
    """
    every = sparsest(seen.kept)
    if every > 1 and _drowned(seen):
        return replace(config, objective="trajectory"), named.every
    return config, every


def _drowned(seen: Look) -> bool:
    """Whether noise hides how the motion curves over one recorded step, which it does where steps are fine."""
    t = seen.kept.triples(seen.base.max_step)
    curved = (t.q2 - t.q1 - (t.h1 / t.h0)[:, None] * (t.q1 - t.q0)) / seen.kept.balance
    return NOISE_OF_R * precision(seen.kept) > DROWNED * float(curved.square().mean().sqrt())


def _spread(seen: Look) -> float:
    return float(((seen.kept.q - seen.kept.q.mean(0)) / seen.kept.balance).square().mean().sqrt())


def _of(stages: Stages, zeros: tuple[float, ...]) -> Stages:
    """The record of what is found out of recordings with these zeros."""
    return stages.labelled(f", zeros {zeros}" if zeros else "")


def _kept(stages: Stages, name: str, find: Callable[[], Apart | None]) -> Apart | None:
    """What `find` finds, or what the checkpoint remembers of it."""
    kept = stages.keep(name, lambda: {} if (found := find()) is None else asdict(found))
    return from_plain(Apart, kept) if kept else None


def _reasoned(plan: Plan, why: str) -> Plan:
    return replace(plan, reasons={**plan.reasons, "objective": why, "network": why})


def _held_out(seen: Look, config: FitConfig, plan: Plan, every: int = 1) -> dict[str, Any]:
    """Error of the free run over the rest of the training part, and the fit to its first part, in plain values.

    Beside it the same of errors that count up to the spread, `until`: of free runs that are lost, as of chaos, it tells
    how long they follow; and that of windows of 20 steps.
    """
    inner, silent = replace(config, train_fraction=INNER), Stages()
    inside = look(seen.train.thinned(every), inner, silent, replace(plan, zeros=()))  # which `seen` has taken off
    task = Task(inside.kept, inside.base, inside.settings, silent, hurried=True)
    fitted = OBJECTIVES[plan.objective](task, inside, plan)
    errors, spread = free_run_errors(task, inside, fitted), _spread(seen)
    rms, until = (float(e.square().mean().sqrt()) for e in (errors, errors.clamp(-spread, spread)))
    found: dict[str, Any] = {"rms": rms, "until": until, "sigma": fitted.sigma}
    if len(seen.train) > 1 and config.find_zeros is not False and plan.network == "none" and inside.unseen is not None:
        error = unseen_window_errors(task, fitted, inside.unseen) / inside.train.balance
        found["windows"] = float(error.square().mean().sqrt())
    found["start"] = {name: x.detach().reshape(-1).tolist() for name, x in fitted.model.named_parameters()}
    departure = fitted.notes.get("departure")
    return found if departure is None else found | {"departure": departure}
