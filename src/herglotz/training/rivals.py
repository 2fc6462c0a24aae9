"""Named terms or networks: each is fitted to the first part of the training data, and runs free over the rest.

Free runs on held-out time decide what no residual can. It costs one fit of each: named terms start from the values that
their search found on all training data, and are alone where they meet the held-out time at the noise already. Networks
have to err less by a twentieth; they are tried on as few samples as tell the motion. Where named terms lose, the last
fit goes on from what networks have learned.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from herglotz.data import MIN_SAMPLES, Trajectories
from herglotz.data.roughness import AT_THE_NOISE, precision, relative_spread, sparsest
from herglotz.training.choose import choose
from herglotz.training.config import FitConfig
from herglotz.training.cross_validation import MARGIN
from herglotz.training.evaluate import free_run_errors
from herglotz.training.look import Look, look, on_a_line
from herglotz.training.objectives import OBJECTIVES
from herglotz.training.one_step_fit import NOISE_OF_R
from herglotz.training.plan import Plan
from herglotz.training.stages import Stages
from herglotz.training.task import Task
from herglotz.training.trials import SEEN

DROWNED = 0.1  # of a recorded step's curvature: noise above it would be most of what one-step errors minimise


def held_out_winner(data: Trajectories, config: FitConfig, stages: Stages, seen: Look) -> tuple[Look, Plan]:
    """The plan whose free run over the last quarter of the training part errs less, with its look at the data."""
    named, shortest = choose(seen, config), min(seen.train.lengths)
    if shortest - round(SEEN * shortest) < MIN_SAMPLES:
        return seen, _reasoned(named, f"{shortest} samples of a recording leave none to hold out")
    first = stages.keep("held out, named terms", lambda: _held_out(seen, config, named))
    if first["rms"] <= AT_THE_NOISE * precision(seen.kept):
        return seen, _reasoned(
            named, f"free runs over held-out time miss {first['rms']:.2g} with named terms: the noise"
        )
    asked, every = _as_fitted(seen, config)
    other = _without_names(data, asked, stages, seen)
    networks = choose(other, asked)
    second = stages.keep("held out, networks", lambda: _held_out(seen, config, networks, every))
    why = f"free runs over the last quarter of the training part miss {first['rms']:.2g} with named terms, "
    why += f"{second['rms']:.2g} with networks ({networks.objective})"
    if lost := min(first["rms"], second["rms"]) > relative_spread(seen.kept):
        why += f"; both are lost: with errors up to the spread they miss {first['until']:.2g} and {second['until']:.2g}"
    if first[by := "until" if lost else "rms"] <= MARGIN * second[by]:
        return seen, _reasoned(named, why)
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
    data = data if seen.turning else on_a_line(data)
    other = look(data, config, _of(stages, seen.zeros), named=False, zeros=seen.zeros)
    other = other if data.u is None else replace(other, why_arrival=seen.why_arrival)
    found = {"why_zeros": seen.why_zeros, "turning": seen.turning}
    return replace(other, **found) if seen.why_zeros or not seen.turning else other


def _going_on(seen: Look, found: dict[str, Any]) -> Look:
    """From the parameters that were fitted to the first part."""
    start = {name: tuple(values) for name, values in found["start"].items()}
    named = seen.found and seen.found._replace(sigma=found["sigma"])
    return replace(seen, base=replace(seen.base, start={**seen.base.start, **start}), found=named)


def _as_fitted(seen: Look, config: FitConfig) -> tuple[FitConfig, int]:
    """The settings of networks, and how many samples are one where they are tried: what is tried is what is fitted.

    One-step errors of all samples would teach them another model where single recorded steps drown in noise: whole
    trajectories of all samples are tried there.
    """
    every = sparsest(seen.kept)
    if every > 1 and _drowned(seen):
        return replace(config, objective="trajectory"), 1
    return config, every


def _drowned(seen: Look) -> bool:
    """Whether noise hides how the motion curves over one recorded step, which it does where steps are fine."""
    t = seen.kept.triples(seen.base.max_step)
    curved = (t.q2 - t.q1 - (t.h1 / t.h0)[:, None] * (t.q1 - t.q0)) / seen.kept.balance
    return NOISE_OF_R * precision(seen.kept) > DROWNED * float(curved.square().mean().sqrt())


def _of(stages: Stages, zeros: tuple[float, ...]) -> Stages:
    """The record of what is found out of recordings with these zeros."""
    return stages.labelled(f", zeros {zeros}" if zeros else "")


def _reasoned(plan: Plan, why: str) -> Plan:
    return replace(plan, reasons={**plan.reasons, "objective": why, "network": why})


def _held_out(seen: Look, config: FitConfig, plan: Plan, every: int = 1) -> dict[str, Any]:
    """Error of the free run over the rest of the training part, and the fit to its first part, in plain values.

    Beside it the same of errors that count up to the spread, `until`: of free runs that are lost, as of chaos, it tells
    how long they follow; and that of windows of 20 steps.
    """
    inner, silent = replace(config, train_fraction=SEEN), Stages()
    inside = look(seen.train.thinned(every), inner, silent, replace(plan, zeros=()))  # which `seen` has taken off
    task = Task(inside.kept, inside.base, inside.settings, silent, hurried=True)
    fitted = OBJECTIVES[plan.objective](task, inside, plan)
    errors, spread = free_run_errors(task, inside, fitted), relative_spread(seen.kept)
    rms, until = (float(e.square().mean().sqrt()) for e in (errors, errors.clamp(-spread, spread)))
    found: dict[str, Any] = {"rms": rms, "until": until, "sigma": fitted.sigma}
    found["start"] = {name: x.detach().reshape(-1).tolist() for name, x in fitted.model.named_parameters()}
    departure = fitted.notes.get("departure")
    return found if departure is None else found | {"departure": departure}
